// The perceptron on AMX tiles: products of bfloat16, sums in float32 (GramGAN Eq. 5, style folded in).
//
// A weight tile is 16 outputs x 32 inputs, an activation tile 32 inputs x 16 points with two inputs side by side (a
// "pair"), a sum tile 16 outputs x 16 points. Two by two tiles of sums are accumulated at a time.
//
// In float32 precision every number is split into two bfloat16, high and low parts, and three products are summed,
// high x high + high x low + low x high. Activations are cut off, not rounded, so that what is left out is up to 2^-14 of a
// product, and 2^-17 typically.
#pragma once

#include <immintrin.h>

#include <cstring>

#include "sampler.hpp"
#include "simd_avx512bf16.hpp"

namespace {

constexpr int AMX_BLOCK = 64;                // points; in bfloat16, two layers' activations and a row of weights fit the first-level cache
constexpr int STRIPS = AMX_BLOCK / 16;       // of 16 points
static_assert(PADDING % AMX_BLOCK == 0, "whole blocks of eta");
// A layer begins with its first two strips while the last two of the layer before are still on their way (`Pending`).
static_assert(STRIPS >= 4 && STRIPS % 2 == 0, "two strips at a time, of at least four");
constexpr int TILE = 16 * 32;                // bfloat16 numbers in a tile, 1 KiB
constexpr int ROW_BYTES = 64;

typedef uint16_t bfloat;

// GCC's tile intrinsics do not say that they read and write memory.
inline void memory_barrier() { __asm__ volatile("" ::: "memory"); }

inline int tiles(int inputs) { return (inputs + 31) / 32; }
inline int unit_tiles(const Layer& layer) { return tiles(layer.units); }
inline int parts(const Sampler& sampler) { return sampler.bfloat16 ? 1 : 2; }

// The bin's few octaves leave room in their tile: split, they are there three times, as high, low and high parts beside
// weights' high, high and low parts, and one product does for three.
inline int bin_inputs(const Sampler& sampler, const Layer& layer) { return layer.octaves * (sampler.bfloat16 ? 1 : 3); }
inline int bin_tiles(const Sampler& sampler, const Layer& layer) { return tiles(bin_inputs(sampler, layer)); }

inline float to_float(bfloat value) {
  uint32_t bits = uint32_t(value) << 16;
  float result;
  memcpy(&result, &bits, 4);
  return result;
}

// Packed: the bias, then per row of 16 outputs the weight tiles: of the units, high parts, of the units, low parts, of the
// bin. Inputs are filled up to whole tiles with zeros. The last layer stays as it is: three outputs are not worth a tile.
size_t bias_bytes(const Layer& layer) { return (sizeof(float) * layer.outputs + 63) / 64 * 64; }

int row_tiles(const Sampler& sampler, const Layer& layer) {
  return parts(sampler) * unit_tiles(layer) + bin_tiles(sampler, layer);
}

size_t amx_packed_bytes(const Sampler& sampler, const Layer& layer) {
  if (layer.outputs == 3) return sizeof(float) * 3 * (layer.units + 1);
  return bias_bytes(layer) + size_t(layer.outputs / 16) * 1024 * row_tiles(sampler, layer);
}

bfloat part_of(float value, bool low) {
  const bfloat high = bfloat(round_to_bfloat16(value));
  return low ? bfloat(round_to_bfloat16(value - to_float(high))) : high;
}

// The number in a column of a row of weight tiles.
bfloat tile_weight(const Sampler& sampler, const Layer& layer, int column, int output) {
  const int part_columns = 32 * unit_tiles(layer), part = part_columns ? column / part_columns : parts(sampler);
  if (part < parts(sampler)) {
    const int unit = column % part_columns;
    return unit < layer.units ? part_of(layer.weights[size_t(unit) * layer.outputs + output], part == 1) : 0;
  }
  const int input = column - parts(sampler) * part_columns;
  if (input >= bin_inputs(sampler, layer)) return 0;
  return part_of(layer.weights[size_t(layer.units + input % layer.octaves) * layer.outputs + output], input >= 2 * layer.octaves);
}

void amx_pack(const Sampler& sampler, const Layer& layer, void* packed) {
  float* bias = static_cast<float*>(packed);
  memcpy(bias, layer.bias, sizeof(float) * layer.outputs);
  if (layer.outputs == 3) {
    memcpy(bias + 3, layer.weights, sizeof(float) * 3 * layer.units);
    return;
  }
  bfloat* to = reinterpret_cast<bfloat*>(static_cast<char*>(packed) + bias_bytes(layer));
  for (int first = 0; first < layer.outputs; first += 16)
    for (int tile = 0; tile < row_tiles(sampler, layer); tile++)
      for (int i = 0; i < TILE; i++) *to++ = tile_weight(sampler, layer, 32 * tile + i % 32, first + i / 32);
}

// Scratch: two buffers of activations [part][strip][tile], the bins [4][strip][tile], two times 2 x 2 sums.
size_t activation_numbers(const Sampler& sampler) { return size_t(parts(sampler)) * STRIPS * tiles(sampler.width) * TILE; }
size_t bin_numbers(const Sampler& sampler) { return size_t(STRIPS) * bin_tiles(sampler, sampler.layer[0]) * TILE; }

size_t amx_scratch_bytes(const Sampler& sampler) {
  return sizeof(bfloat) * (2 * activation_numbers(sampler) + 4 * bin_numbers(sampler)) + 2 * 4096;
}

struct __attribute__((packed)) TileShapes {
  uint8_t palette = 1, start_row = 0, reserved[14] = {};
  uint16_t row_bytes[16] = {};
  uint8_t rows[16] = {};
};

// Stores a row of pairs; split, the high parts there and the low parts `low` numbers further on.
template <bool split> inline void store_pairs(bfloat* to, size_t low, __m512 even, __m512 odd) {
  if (!split) {
    _mm512_store_si512(to, pairs(even, odd));
    return;
  }
  const __m512i upper = _mm512_set1_epi32(int32_t(0xffff0000));
  __m512i even_high = _mm512_and_si512(_mm512_castps_si512(even), upper);  // cut off, not rounded: the low part has the rest
  __m512i odd_high = _mm512_and_si512(_mm512_castps_si512(odd), upper);
  _mm512_store_si512(to, _mm512_or_si512(_mm512_srli_epi32(even_high, 16), odd_high));
  _mm512_store_si512(to + low, pairs(_mm512_sub_ps(even, _mm512_castsi512_ps(even_high)),
                                     _mm512_sub_ps(odd, _mm512_castsi512_ps(odd_high))));
}

// The octaves of one bin as activation tiles; rows without an octave stay zero.
template <bool split> void load_bin(const Sampler& sampler, const float* eta, bfloat* bin) {
  const int octaves = sampler.layer[0].octaves;
  for (int s = 0; s < STRIPS; s++, bin += bin_numbers(sampler) / STRIPS, eta += 16)
    for (int k = 0; k < octaves; k += 2) {
      const float* even = eta + size_t(k) * STRIDE;
      bfloat* to = bin + 16 * k;  // tile after tile, 32 inputs of 16 points each
      store_pairs<split>(to, 16 * octaves, _mm512_loadu_ps(even), _mm512_loadu_ps(even + STRIDE));
      if (split) _mm512_store_si512(to + 32 * octaves, _mm512_load_si512(to));
    }
}

// Two weight tiles (4, 5) by two activation tiles (6, 7), into the sums (0 to 3).
inline void multiply_tiles() {
  _tile_dpbf16ps(0, 4, 6);
  _tile_dpbf16ps(1, 4, 7);
  _tile_dpbf16ps(2, 5, 6);
  _tile_dpbf16ps(3, 5, 7);
}

// Sums of one output at 16 points through phi: the bias is added here, for a tile to start from costs more than an addition.
inline __m512 activate(const float* sums, float bias) {
  const __m512 sum = _mm512_add_ps(_mm512_load_ps(sums), _mm512_set1_ps(bias));
  return _mm512_max_ps(sum, _mm512_mul_ps(sum, _mm512_set1_ps(SLOPE)));
}

// Finished sums of 2 x 2 tiles on their way into the next layer's activations or, from the last hidden layer, into colours.
// That is done a tile at a time, between the tile operations of the next sums, which leave the vector units idle.
struct Pending {
  const float* sums = nullptr;  // 4 tiles, 16 outputs x 16 points each
  int tile = 0, tiles = 0;
  const float* bias[4];
  bfloat* to[4];
  size_t low;
  const float* color_weights[4];  // null for all but the last hidden layer
  float* rgb[4];                  // 16 of [3, AMX_BLOCK]

  template <bool split> void advance(int count) {
    for (const int end = tile + count < tiles ? tile + count : tiles; tile < end; tile++)
      if (color_weights[0]) add_color();
      else pass_on<split>();
  }

  template <bool split> void pass_on() const {
    const float *from = sums + 256 * tile, *added = bias[tile];
    bfloat* next = to[tile];
    for (int row = 0; row < 16; row += 2)
      store_pairs<split>(next + 16 * row, low, activate(from + 16 * row, added[row]), activate(from + 16 * row + 16, added[row + 1]));
  }

  void add_color() const {
    float* color = rgb[tile];
    __m512 red = _mm512_loadu_ps(color), green = _mm512_loadu_ps(color + AMX_BLOCK), blue = _mm512_loadu_ps(color + 2 * AMX_BLOCK);
    const float* weights = color_weights[tile];
    for (int row = 0; row < 16; row++, weights += 3) {
      const __m512 unit = activate(sums + 256 * tile + 16 * row, bias[tile][row]);
      red = _mm512_fmadd_ps(unit, _mm512_set1_ps(weights[0]), red);
      green = _mm512_fmadd_ps(unit, _mm512_set1_ps(weights[1]), green);
      blue = _mm512_fmadd_ps(unit, _mm512_set1_ps(weights[2]), blue);
    }
    _mm512_storeu_ps(color, red);
    _mm512_storeu_ps(color + AMX_BLOCK, green);
    _mm512_storeu_ps(color + 2 * AMX_BLOCK, blue);
  }
};

// Sums of two rows of outputs and two strips, tiles 0 to 3: += weights x activations over `count` tiles of inputs.
template <bool split, bool three_products>
inline void multiply(const char* weights, size_t row, size_t low, const bfloat* in, size_t strip, size_t in_low, int count,
                     Pending& pending, int passed) {
  for (int k = 0; k < count; k++, weights += 1024, in += TILE) {
    _tile_loadd(4, weights, ROW_BYTES);
    _tile_loadd(5, weights + row, ROW_BYTES);
    if (three_products) {
      _tile_loadd(6, in + in_low, ROW_BYTES);
      _tile_loadd(7, in + in_low + strip, ROW_BYTES);
      multiply_tiles();
    }
    _tile_loadd(6, in, ROW_BYTES);
    _tile_loadd(7, in + strip, ROW_BYTES);
    multiply_tiles();
    if (three_products) {
      _tile_loadd(4, weights + low, ROW_BYTES);
      _tile_loadd(5, weights + low + row, ROW_BYTES);
      multiply_tiles();
    }
    pending.advance<split>(passed);
  }
}

// One hidden layer of one block. The last one goes on to `rgb` instead of `out`.
template <bool split>
void amx_layer(const Sampler& sampler, int l, const bfloat* units, const bfloat* bin, bfloat* out, float* (&sums)[2], float* rgb,
               Pending& pending) {
  const Layer& layer = sampler.layer[l];
  const bool last = l == sampler.hidden_layers - 1;
  const size_t strip = size_t(tiles(sampler.width)) * TILE, in_low = STRIPS * strip;
  const int own = unit_tiles(layer), of_bin = bin_tiles(sampler, layer), all = own + of_bin;
  const size_t low = size_t(own) * 1024, bin_at = low * (split ? 2 : 1), row = size_t(row_tiles(sampler, layer)) * 1024;
  const size_t bin_strip = size_t(of_bin) * TILE;
  const float* color = static_cast<const float*>(sampler.layer[l + 1].packed) + 3;
  const float* bias = static_cast<const float*>(layer.packed);
  const char* weights = static_cast<const char*>(layer.packed) + bias_bytes(layer);
  for (int output = 0; output < layer.outputs; output += 32, weights += 2 * row) {
    const bool both = output + 16 < layer.outputs;  // an odd last row of tiles is computed twice and used once
    const size_t next = both ? row : 0;
    for (int s = 0; s < STRIPS; s += 2) {
      const int passed = (pending.tiles + all - 1) / all;
      memory_barrier();
      _tile_zero(0);
      _tile_zero(1);
      _tile_zero(2);
      _tile_zero(3);
      multiply<split, split>(weights, next, low, units + s * strip, strip, in_low, own, pending, passed);
      multiply<split, false>(weights + bin_at, next, 0, bin + s * bin_strip, bin_strip, 0, of_bin, pending, passed);
      pending.advance<split>(4);
      _tile_stored(0, sums[0], ROW_BYTES);
      _tile_stored(1, sums[0] + 256, ROW_BYTES);
      _tile_stored(2, sums[0] + 512, ROW_BYTES);
      _tile_stored(3, sums[0] + 768, ROW_BYTES);
      memory_barrier();
      pending.sums = sums[0];
      pending.tile = 0, pending.tiles = both ? 4 : 2, pending.low = in_low;
      for (int t = 0; t < 4; t++) {
        const int first = output + 16 * (t / 2);
        pending.bias[t] = bias + first;
        pending.to[t] = out + (s + t % 2) * strip + first / 32 * TILE + first % 32 * 16;
        pending.color_weights[t] = last ? color + 3 * first : nullptr;
        pending.rgb[t] = rgb + 16 * (s + t % 2);
      }
      float* former = sums[0];
      sums[0] = sums[1], sums[1] = former;
    }
  }
}

template <bool split> void amx_blocks(const Sampler& sampler, const float* eta, int count, float* rgb, void* scratch) {
  bfloat* units = static_cast<bfloat*>(scratch);
  bfloat* out = units + activation_numbers(sampler);
  bfloat* bins = out + activation_numbers(sampler);
  float* first_sums = reinterpret_cast<float*>(bins + 4 * bin_numbers(sampler));
  float* sums[2] = {first_sums, first_sums + 1024};
  Pending pending;
  const int bin = sampler.octaves / 4;
  const float* color_bias = static_cast<const float*>(sampler.layer[sampler.hidden_layers].packed);
  for (int first = 0; first < count; first += AMX_BLOCK) {
    float block[3 * AMX_BLOCK];
    for (int i = 0; i < 3 * AMX_BLOCK; i++) block[i] = color_bias[i / AMX_BLOCK];
    for (int b = 0; b < 4; b++) load_bin<split>(sampler, eta + first + size_t(b * bin) * STRIDE, bins + b * bin_numbers(sampler));
    for (int l = 0; l < sampler.hidden_layers; l++) {
      amx_layer<split>(sampler, l, units, bins + (l < 4 ? l : 0) * bin_numbers(sampler), out, sums, block, pending);
      bfloat* former = units;
      units = out, out = former;
    }
    pending.advance<split>(4);
    for (int point = first; point < first + AMX_BLOCK && point < count; point++)
      for (int channel = 0; channel < 3; channel++) rgb[3 * point + channel] = block[channel * AMX_BLOCK + point - first];
  }
}

void amx_perceive(const Sampler& sampler, const float* eta, int count, float* rgb, void* scratch) {
  TileShapes shapes;
  for (int i = 0; i < 8; i++) shapes.row_bytes[i] = ROW_BYTES, shapes.rows[i] = 16;
  __asm__ volatile("" ::"r"(&shapes) : "memory");  // GCC 12 believes that eight bytes of it are read
  _tile_loadconfig(&shapes);
  memset(scratch, 0, amx_scratch_bytes(sampler));  // what fills up the last tiles must be zero
  (sampler.bfloat16 ? amx_blocks<false> : amx_blocks<true>)(sampler, eta, count, rgb, scratch);
  _tile_release();
}

}  // namespace
