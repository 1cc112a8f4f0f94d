// The fused sampler's C interface: what `solidgrain.runtime.kernel` calls through ctypes.
//
// GramGAN Eq. 1 and 5 for any number of points: noise lookup and the whole perceptron, a block of points at a time, with
// every intermediate value in registers or in the core's own caches (the noise of 32 octaves takes 528 KiB). One sampler is
// one instance of a texture (its tables, its transforms, its folded weights), made once and then only read, so any number of
// threads may share it.
//
// A point's colour depends on the sampler and on the point alone: not on its block, its neighbours or the thread.
#pragma once

#include <cstdint>

#define SOLIDGRAIN_API extern "C" __attribute__((visibility("default")))

struct Sampler;

// What a sampler is made of. Nothing here needs to outlive `solidgrain_open`.
struct SamplerDescription {
  int32_t octaves;        // n, in four equal bins; a multiple of 8, at most 128
  int32_t width;          // m, units of a hidden layer; a multiple of 16
  int32_t hidden_layers;  // 4 or more; bin l enters layer l = 0 .. 3
  int32_t bfloat16;       // 0: float32 results; 1: bfloat16 tables, activations and weights (paths "amx" and "avx512bf16")
  int32_t tiled;          // 0: every octave repeats after 64 texels; 1: on its `lattice`
  const double* transforms;  // [n, 3, 3], T_i
  const double* offsets;     // [n, 3]
  const double* lattice;     // [n, 3, 3], lower-triangular, whole numbers; column k has its pivot in row k
  const float* noise;        // [n, 64, 64, 64]
  // The folded perceptron, one layer after the other, hidden layers first: the bias [outputs], then the matrix
  // [inputs, outputs]. The inputs of hidden layer l are the m units of layer l - 1 (none for l = 0), then the n/4 octaves
  // of bin l (none for l > 3). The last layer has 3 outputs.
  const float* weights;
};

// The version of this interface; the caller compares it with its own before anything else.
constexpr int32_t SOLIDGRAIN_ABI = 1;
SOLIDGRAIN_API int32_t solidgrain_abi();

// The paths that this build and this processor have, best first, comma-separated: some of
// "amx,avx512bf16,avx512,avx2,portable".
SOLIDGRAIN_API const char* solidgrain_paths();

// A sampler that runs on the named path, or null if there is no such path here or not enough memory.
SOLIDGRAIN_API Sampler* solidgrain_open(const SamplerDescription* description, const char* path);
SOLIDGRAIN_API void solidgrain_close(Sampler* sampler);

// Colour at points [count, 3] (x, y, z), float64, finite -> rgb [count, 3], clipped to [0, 1].
// Returns -1, or the index of the first point whose colour came out as NaN or infinite; -2 if there is not enough memory.
SOLIDGRAIN_API int64_t solidgrain_points(const Sampler* sampler, const double* points, int64_t count, float* rgb);

// A grid's voxels are evaluated in bricks, whose points lie close together in every octave's table. How many there are in a
// grid of this shape; any of them may be evaluated at any time, by any thread.
SOLIDGRAIN_API int64_t solidgrain_bricks(int64_t columns, int64_t rows, int64_t planes);

// Colour at the voxels of bricks first .. first + count - 1 of the grid whose coordinates along the axes are x [columns],
// y [rows] and z [planes] -> their places in rgb [planes, rows, columns, 3]. Returns as above, with the voxel's index.
SOLIDGRAIN_API int64_t solidgrain_grid(const Sampler* sampler, const double* x, int64_t columns, const double* y,
                                       int64_t rows, const double* z, int64_t planes, int64_t first, int64_t count, float* rgb);
