// What all paths share: the data of one instance of a texture, and what a path is.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstring>

constexpr int RESOLUTION = 64;               // texels along each axis of a noise table
constexpr int ROW = RESOLUTION + 1;          // stored texels along z: the first again, so that neighbours are always adjacent
constexpr int64_t TABLE = int64_t(RESOLUTION) * RESOLUTION * ROW;
constexpr int64_t TEXELS = int64_t(RESOLUTION) * RESOLUTION * RESOLUTION;
constexpr float SLOPE = 0.2f;                // of the leaky ReLU (gramgan/models.py)
constexpr int SWEEP = 4096;                  // points per sweep over the octaves: one table at a time is in the cache
constexpr int PADDING = 192;                 // points are filled up to a multiple of every path's block
constexpr int STRIDE = (SWEEP + PADDING - 1) / PADDING * PADDING;  // floats from one octave's eta to the next
constexpr size_t ALIGNMENT = 64;

// The upper half of a float, to the nearest, ties to even.
static inline uint32_t round_to_bfloat16(float value) {
  uint32_t bits;
  memcpy(&bits, &value, 4);
  if (value != value) return 0x7fc0;  // the sum below would carry some NaNs over into zero
  return (bits + 0x7fff + (bits >> 16 & 1)) >> 16;
}

// One octave of noise: c = T p + o, looked up modulo 64 or modulo a lattice.
struct Octave {
  double transform[9];
  double offset[3];
  double lattice[9];   // row-major, lower-triangular
  const void* table;   // [64, 64, 65] float or bfloat16
};

// One layer of the perceptron, style folded in.
struct Layer {
  int units;             // inputs that are units of the layer before
  int octaves;           // inputs that are octaves of this layer's bin
  int outputs;
  const float* bias;     // [outputs]
  const float* weights;  // [units + octaves, outputs]
  const void* packed;    // the same in the order in which the path reads it
};

struct Path;

struct Sampler {
  const Path* path;
  int octaves, width, hidden_layers;
  bool bfloat16, tiled;
  Octave* octave;  // [octaves]
  Layer* layer;    // [hidden_layers + 1]
};

// One way to evaluate, compiled for one family of processors.
struct Path {
  const char* name;
  bool bfloat16;  // whether it offers that precision
  size_t (*packed_bytes)(const Sampler&, const Layer&);
  void (*pack)(const Sampler&, const Layer&, void* packed);
  size_t (*scratch_bytes)(const Sampler&);
  // Noise of `count` points (a multiple of 16): eta [octaves, STRIDE]. With `rows`, each 16 of them share y and z.
  void (*look_up)(const Sampler&, const double* x, const double* y, const double* z, int count, bool rows, float* eta);
  // Colour of `count` points: rgb [count, 3], not clipped.
  void (*perceive)(const Sampler&, const float* eta, int count, float* rgb, void* scratch);
};

// What the compiler knows: GCC has AVX-512 BF16 since 10, AMX since 11.
#if defined(__x86_64__) && (defined(__clang__) || __GNUC__ >= 10)
#define SOLIDGRAIN_AVX512BF16 1
#endif
#if defined(__x86_64__) && (defined(__clang__) || __GNUC__ >= 11)
#define SOLIDGRAIN_AMX 1
#endif

extern const Path portable_path, avx2_path, avx512_path, avx512bf16_path, amx_path;
