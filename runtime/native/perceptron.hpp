// The perceptron in float32 (GramGAN Eq. 5, style folded in): y = phi(W x + A eta + b), blocks of points, fused.
//
// A block's activations are [units, BLOCK]: a vector holds one unit of many points, a weight is broadcast. The bin's rows of
// eta follow the units' rows in the same accumulation, so A rides along with W. Every point is summed in the same order.
#pragma once

#include "sampler.hpp"

namespace {

constexpr int BLOCK = 48;  // points; two buffers of 128 units fill the first-level cache

// Weights as the tiles read them: [outputs / TILE_OUTPUTS, inputs, TILE_OUTPUTS], the last group filled up with zeros.
template <class S> size_t packed_bytes(const Sampler&, const Layer& layer) {
  int groups = (layer.outputs + S::TILE_OUTPUTS - 1) / S::TILE_OUTPUTS;
  return sizeof(float) * groups * S::TILE_OUTPUTS * (layer.units + layer.octaves + 1);
}

template <class S> void pack(const Sampler&, const Layer& layer, void* packed) {
  float* to = static_cast<float*>(packed);
  for (int first = 0; first < layer.outputs; first += S::TILE_OUTPUTS)
    for (int input = -1; input < layer.units + layer.octaves; input++)  // the bias is in front
      for (int output = first; output < first + S::TILE_OUTPUTS; output++) {
        const float* row = input < 0 ? layer.bias : layer.weights + size_t(input) * layer.outputs;
        *to++ = output < layer.outputs ? row[output] : 0;
      }
}

template <class S> using Tile = typename S::F[S::TILE_OUTPUTS][S::TILE_VECTORS];

// `inputs` rows of `from`, `stride` floats apart, into the accumulators.
template <class S> inline const float* accumulate(Tile<S>& sum, const float* weights, int inputs, const float* from, size_t stride) {
  for (int k = 0; k < inputs; k++, from += stride, weights += S::TILE_OUTPUTS) {
    typename S::F in[S::TILE_VECTORS];
#pragma GCC unroll 4
    for (int v = 0; v < S::TILE_VECTORS; v++) in[v] = S::load(from + v * S::LANES);
#pragma GCC unroll 8
    for (int n = 0; n < S::TILE_OUTPUTS; n++) {
      auto weight = S::all(weights[n]);
#pragma GCC unroll 4
      for (int v = 0; v < S::TILE_VECTORS; v++) sum[n][v] = S::fma(weight, in[v], sum[n][v]);
    }
  }
  return weights;
}

// One layer of one block: units [layer.units, BLOCK] and eta rows -> out [outputs rounded up, BLOCK].
template <class S, bool hidden>
void evaluate_layer(const Layer& layer, const float* units, const float* eta, float* out) {
  const float* weights = static_cast<const float*>(layer.packed);
  const size_t group = size_t(layer.units + layer.octaves + 1) * S::TILE_OUTPUTS;
  const auto slope = S::all(SLOPE);
  for (int first = 0; first < layer.outputs; first += S::TILE_OUTPUTS, weights += group)
    for (int point = 0; point < BLOCK; point += S::TILE_VECTORS * S::LANES) {
      Tile<S> sum;
      for (int n = 0; n < S::TILE_OUTPUTS; n++)
        for (int v = 0; v < S::TILE_VECTORS; v++) sum[n][v] = S::all(weights[n]);
      const float* next = accumulate<S>(sum, weights + S::TILE_OUTPUTS, layer.units, units + point, BLOCK);
      accumulate<S>(sum, next, layer.octaves, eta + point, STRIDE);
      for (int n = 0; n < S::TILE_OUTPUTS; n++)
        for (int v = 0; v < S::TILE_VECTORS; v++)
          S::store(out + size_t(first + n) * BLOCK + point + v * S::LANES, hidden ? S::leaky(sum[n][v], slope) : sum[n][v]);
    }
}

template <class S> size_t scratch_bytes(const Sampler& sampler) {
  return sizeof(float) * 2 * BLOCK * (sampler.width + S::TILE_OUTPUTS);
}

template <class S> void perceive(const Sampler& sampler, const float* eta, int count, float* rgb, void* scratch) {
  const int bin = sampler.octaves / 4;
  for (int first = 0; first < count; first += BLOCK, eta += BLOCK) {
    float* units = static_cast<float*>(scratch);
    float* out = units + size_t(BLOCK) * (sampler.width + S::TILE_OUTPUTS);
    for (int l = 0; l <= sampler.hidden_layers; l++) {
      const Layer& layer = sampler.layer[l];
      const float* own = eta + size_t(layer.octaves ? l * bin : 0) * STRIDE;
      (l < sampler.hidden_layers ? evaluate_layer<S, true> : evaluate_layer<S, false>)(layer, units, own, out);
      float* former = units;
      units = out, out = former;
    }
    for (int point = first; point < first + BLOCK && point < count; point++)
      for (int channel = 0; channel < 3; channel++) rgb[3 * point + channel] = units[channel * BLOCK + point - first];
  }
}

}  // namespace
