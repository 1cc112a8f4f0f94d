// The perceptron in vectors (GramGAN Eq. 5, style folded in): y = phi(W x + A eta + b), blocks of points, fused.
//
// A block's activations are [words, BLOCK]: a vector holds one word of many points, a weight is broadcast. A word is one unit in
// float32 (`Floats`) or, where the processor multiplies them, a pair of units in bfloat16 (simd_avx512bf16.hpp); sums are float32
// in either case. The bin's rows of eta follow the units' rows in the same accumulation, so A rides along with W. Every point
// is summed in the same order.
#pragma once

#include <cstring>

#include "sampler.hpp"

namespace {

constexpr int BLOCK = 48;  // points; one of two buffers of 128 units fits the first-level cache (half as many: no faster)
static_assert(PADDING % BLOCK == 0, "whole blocks of eta");

template <class S> struct Floats {
  static constexpr int INPUTS = 1;  // of a word
  static void pack(const float (&weights)[1], float* word) { *word = weights[0]; }
  static typename S::F join(const typename S::F* inputs) { return inputs[0]; }
  static typename S::F add_product(typename S::F weight, typename S::F input, typename S::F sum) {
    return S::fma(weight, input, sum);
  }
};

// Weights as the tiles read them: [outputs / TILE_OUTPUTS, words, TILE_OUTPUTS], the last group filled up with zeros.
template <class S, class W> size_t packed_words(const Layer& layer) {
  return size_t((layer.units + layer.octaves) / W::INPUTS + 1) * S::TILE_OUTPUTS;  // of a group; the bias is in front
}

template <class S, class W = Floats<S>> size_t packed_bytes(const Sampler&, const Layer& layer) {
  return sizeof(float) * packed_words<S, W>(layer) * ((layer.outputs + S::TILE_OUTPUTS - 1) / S::TILE_OUTPUTS);
}

template <class S, class W = Floats<S>> void pack(const Sampler&, const Layer& layer, void* packed) {
  float* to = static_cast<float*>(packed);
  auto weight = [&](int input, int output) {
    return output < layer.outputs ? layer.weights[size_t(input) * layer.outputs + output] : 0;
  };
  for (int first = 0; first < layer.outputs; first += S::TILE_OUTPUTS) {
    const int stop = first + S::TILE_OUTPUTS;
    for (int output = first; output < stop; output++) *to++ = output < layer.outputs ? layer.bias[output] : 0;
    for (int input = 0; input < layer.units + layer.octaves; input += W::INPUTS)
      for (int output = first; output < stop; output++) {
        float weights[W::INPUTS];
        for (int k = 0; k < W::INPUTS; k++) weights[k] = weight(input + k, output);
        W::pack(weights, to++);
      }
  }
}

template <class S> using Tile = typename S::F[S::TILE_OUTPUTS][S::TILE_VECTORS];

// So many rows of words of `from`, `stride` floats apart, into the accumulators.
template <class S, class W> inline const float* accumulate(Tile<S>& sum, const float* weights, int rows, const float* from, size_t stride) {
  for (int k = 0; k < rows; k++, from += stride, weights += S::TILE_OUTPUTS) {
    typename S::F in[S::TILE_VECTORS];
#pragma GCC unroll 4
    for (int v = 0; v < S::TILE_VECTORS; v++) in[v] = S::load(from + v * S::LANES);
#pragma GCC unroll 8
    for (int n = 0; n < S::TILE_OUTPUTS; n++) {
      auto weight = S::all(weights[n]);
#pragma GCC unroll 4
      for (int v = 0; v < S::TILE_VECTORS; v++) sum[n][v] = W::add_product(weight, in[v], sum[n][v]);
    }
  }
  return weights;
}

// One layer of one block: rows of words of units, `BLOCK` apart, and of eta, `stride` apart -> out, words of a hidden layer's
// units, or the last layer's sums as they are [outputs rounded up, BLOCK].
template <class S, class W, bool hidden>
void evaluate_layer(const Layer& layer, const float* units, const float* eta, size_t stride, float* out) {
  const float* weights = static_cast<const float*>(layer.packed);
  const auto slope = S::all(SLOPE);
  for (int first = 0; first < layer.outputs; first += S::TILE_OUTPUTS, weights += packed_words<S, W>(layer))
    for (int point = 0; point < BLOCK; point += S::TILE_VECTORS * S::LANES) {
      Tile<S> sum;
      for (int n = 0; n < S::TILE_OUTPUTS; n++)
        for (int v = 0; v < S::TILE_VECTORS; v++) sum[n][v] = S::all(weights[n]);
      const float* next = accumulate<S, W>(sum, weights + S::TILE_OUTPUTS, layer.units / W::INPUTS, units + point, BLOCK);
      accumulate<S, W>(sum, next, layer.octaves / W::INPUTS, eta + point, stride);
      constexpr int joined = hidden ? W::INPUTS : 1;
      for (int n = 0; n < S::TILE_OUTPUTS; n += joined)
        for (int v = 0; v < S::TILE_VECTORS; v++) {
          typename S::F values[joined];
          for (int k = 0; k < joined; k++) values[k] = hidden ? S::leaky(sum[n + k][v], slope) : sum[n + k][v];
          float* to = out + size_t(first + n) / joined * BLOCK + point + v * S::LANES;
          if constexpr (hidden) S::store(to, W::join(values));
          else S::store(to, values[0]);
        }
    }
}

// Scratch: two buffers of units, and where a word is more than a float, one of the octaves.
template <class S> constexpr size_t unit_floats(int width) { return size_t(BLOCK) * (width + S::TILE_OUTPUTS); }

template <class S, class W = Floats<S>> size_t scratch_bytes(const Sampler& sampler) {
  return sizeof(float) * (2 * unit_floats<S>(sampler.width) + (W::INPUTS > 1 ? BLOCK * sampler.octaves / W::INPUTS : 0));
}

// A block's rows of eta, `STRIDE` apart, as rows of words, `BLOCK` apart.
template <class S, class W> void join_octaves(const float* eta, int octaves, float* to) {
  for (int i = 0; i < octaves; i += W::INPUTS, eta += W::INPUTS * STRIDE, to += BLOCK)
    for (int point = 0; point < BLOCK; point += S::LANES) {
      typename S::F values[W::INPUTS];
      for (int k = 0; k < W::INPUTS; k++) values[k] = S::load(eta + k * STRIDE + point);
      S::store(to + point, W::join(values));
    }
}

template <class S, class W = Floats<S>> void perceive(const Sampler& sampler, const float* eta, int count, float* rgb, void* scratch) {
  constexpr bool joins = W::INPUTS > 1;
  constexpr size_t stride = joins ? BLOCK : STRIDE;
  const size_t bin = sampler.octaves / 4 / W::INPUTS * stride;
  float* octaves = static_cast<float*>(scratch) + 2 * unit_floats<S>(sampler.width);
  for (int first = 0; first < count; first += BLOCK, eta += BLOCK) {
    if (joins) join_octaves<S, W>(eta, sampler.octaves, octaves);
    const float* bins = joins ? octaves : eta;
    float* units = static_cast<float*>(scratch);
    float* out = units + unit_floats<S>(sampler.width);
    for (int l = 0; l <= sampler.hidden_layers; l++) {
      const Layer& layer = sampler.layer[l];
      const float* own = bins + (layer.octaves ? l * bin : 0);
      (l < sampler.hidden_layers ? evaluate_layer<S, W, true> : evaluate_layer<S, W, false>)(layer, units, own, stride, out);
      float* former = units;
      units = out, out = former;
    }
    for (int point = first; point < first + BLOCK && point < count; point++)
      for (int channel = 0; channel < 3; channel++) rgb[3 * point + channel] = units[channel * BLOCK + point - first];
  }
}

}  // namespace
