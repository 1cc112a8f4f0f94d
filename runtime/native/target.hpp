// Instruction sets per source file, so that the build needs no flags of its own: what follows is compiled for the named
// ones, to the end of the file. System headers come first, or their inline functions would be, too.
#pragma once

#define SOLIDGRAIN_PRAGMA(text) _Pragma(#text)
#if defined(__clang__)
#define SOLIDGRAIN_TARGET(sets) SOLIDGRAIN_PRAGMA(clang attribute push(__attribute__((target(sets))), apply_to = function))
#define SOLIDGRAIN_TARGET_END SOLIDGRAIN_PRAGMA(clang attribute pop)
#else
#define SOLIDGRAIN_TARGET(sets) SOLIDGRAIN_PRAGMA(GCC target(sets))
#define SOLIDGRAIN_TARGET_END  // not popped: templates are instantiated at the end of the file
#endif
