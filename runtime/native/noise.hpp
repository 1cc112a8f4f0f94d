// The octaves of noise (GramGAN Eq. 1): eta_i = the table of octave i, trilinear at T_i p + o_i.
//
// Positions are formed in float64, per point, and split into cell and fraction before anything becomes float32, so that a
// point far away is as exact as one at the origin, and a grid's voxel has the colour of the same point alone.
#pragma once

#include <cmath>

#include "sampler.hpp"

namespace {

// Coordinate `axis` of a vector of points in an octave. In a `row`, they share y and z, and what comes of these is a number.
template <class S, bool row>
inline typename S::D locate(const Octave& octave, int axis, const double* x, const double* y, const double* z) {
  const double* weights = octave.transform + 3 * axis;
  typename S::D sum;
  if constexpr (row) {
    sum = S::all(S::fma(weights[1], *y, S::fma(weights[2], *z, octave.offset[axis])));
  } else {
    sum = S::fma(S::all(weights[2]), S::load(z), S::all(octave.offset[axis]));
    sum = S::fma(S::all(weights[1]), S::load(y), sum);
  }
  return S::fma(S::all(weights[0]), S::load(x), sum);
}

// The eight corners of a cell are four edges along z, x slowest; `low` and `high` are where an edge's two ends are stored.

// Modulo 64 along each axis: `high` is always low + 1.
template <class S, bool coarse>
inline void table_corners(const typename S::D (&at)[3], typename S::I (&low)[4], typename S::F (&fraction)[3]) {
  typename S::I cell[3];
  for (int axis = 0; axis < 3; axis++) {
    auto turns = S::floor(S::mul(at[axis], S::all(1.0 / RESOLUTION)));
    auto inside = S::fma(turns, S::all(-double(RESOLUTION)), at[axis]);
    if constexpr (coarse) {  // to 2^-18 of a texel, for bfloat16
      auto rounded = S::to_float(inside);
      auto whole = S::floor(rounded);
      cell[axis] = S::to_int(whole);
      fraction[axis] = S::sub(rounded, whole);
    } else {
      auto whole = S::floor(inside);
      cell[axis] = S::to_int(whole);
      fraction[axis] = S::to_float(S::sub(inside, whole));
    }
    cell[axis] = S::bit_and(cell[axis], S::all(RESOLUTION - 1));  // just below 0, `inside` is rounded up to 64
  }
  const auto one = S::all(1), mask = S::all(RESOLUTION - 1), plane = S::all(RESOLUTION * ROW), row = S::all(ROW);
  auto x0 = S::mul(cell[0], plane), x1 = S::mul(S::bit_and(S::add(cell[0], one), mask), plane);
  auto y0 = S::add(S::mul(cell[1], row), cell[2]);
  auto y1 = S::add(S::mul(S::bit_and(S::add(cell[1], one), mask), row), cell[2]);
  low[0] = S::add(x0, y0), low[1] = S::add(x0, y1), low[2] = S::add(x1, y0), low[3] = S::add(x1, y1);
}

// A cell's canonical representative modulo a lattice: one floor division per axis, in order. (v + 1/2) / p is never nearer
// to a whole number than 1/2p, so a rounded reciprocal finds the right one below 2^50.
template <class S> inline void canonical(const double* basis, typename S::D (&cell)[3]) {
  for (int axis = 0; axis < 3; axis++) {
    auto turns = S::floor(S::mul(S::add(cell[axis], S::all(0.5)), S::all(1 / basis[4 * axis])));
    for (int row = axis; row < 3; row++) cell[row] = S::fma(turns, S::all(-basis[3 * row + axis]), cell[row]);
  }
}

inline int64_t floor_divide(int64_t value, int64_t divisor) {
  int64_t turns = value / divisor;
  return turns - (turns * divisor > value);
}

// The same in 64-bit integers, one lane after the other, for cells whose products outgrow float64.
template <class S> void canonical_far(const double* basis, typename S::D (&cell)[3]) {
  double lanes[3][S::LANES];
  for (int axis = 0; axis < 3; axis++) S::store(lanes[axis], cell[axis]);
  for (int lane = 0; lane < S::LANES; lane++) {
    int64_t whole[3];
    for (int axis = 0; axis < 3; axis++) whole[axis] = int64_t(lanes[axis][lane]);
    for (int axis = 0; axis < 3; axis++) {
      int64_t turns = floor_divide(whole[axis], int64_t(basis[4 * axis]));
      for (int row = axis; row < 3; row++) whole[row] -= turns * int64_t(basis[3 * row + axis]);
    }
    for (int axis = 0; axis < 3; axis++) lanes[axis][lane] = double(whole[axis]);
  }
  for (int axis = 0; axis < 3; axis++) cell[axis] = S::load(lanes[axis]);
}

// A number modulo 64^3, or anything that is congruent to it.
template <class S> inline typename S::I modulo_texels(typename S::I v) { return v; }
template <class S> inline typename S::I modulo_texels(typename S::D v) {
  return S::to_int(S::fma(S::floor(S::mul(v, S::all(1.0 / TEXELS))), S::all(-double(TEXELS)), v));
}

// From a canonical cell to its corners: one step leaves the canonical range by less than a period along x and y, by less than
// two along z, so there is nothing to divide. A corner's texel is its mixed-radix number modulo 64^3 (`solidgrain.runtime.lattice`).
// Number is I where the lattice allows (`is_small`), D otherwise.
template <class S, class Scalar, class Number>
inline void lattice_edge(const double* basis, const Number (&cell)[3], int edge, typename S::I& low, typename S::I& high) {
  auto entry = [&](int row, int column) { return S::all(Scalar(basis[3 * row + column])); };
  auto minus = [&](int row, int column) { return S::all(Scalar(-basis[3 * row + column])); };
  const Number none = S::all(Scalar(0)), one = S::all(Scalar(1));
  Number x = cell[0], y = cell[1], z = cell[2];
  if (edge & 2) {
    x = S::add(x, one);
    auto over = S::equal(x, entry(0, 0));
    x = S::add_where(over, x, minus(0, 0));
    y = S::add_where(over, y, minus(1, 0));
    z = S::add_where(over, z, minus(2, 0));
    auto under = S::less(y, none);
    y = S::add_where(under, y, entry(1, 1));
    z = S::add_where(under, z, entry(2, 1));
  }
  if (edge & 1) {
    y = S::add(y, one);
    auto over = S::equal(y, entry(1, 1));
    y = S::add_where(over, y, minus(1, 1));
    z = S::add_where(over, z, minus(2, 1));
  }
  if (edge) {
    z = S::add_where(S::less(z, none), z, entry(2, 2));
    z = S::add_where(S::less(z, none), z, entry(2, 2));
    z = S::add_where(S::less(z, entry(2, 2)), S::add(z, minus(2, 2)), entry(2, 2));
  }
  Number above = S::add(z, one);
  above = S::add_where(S::equal(above, entry(2, 2)), above, minus(2, 2));

  auto residue = [](double v) { return S::all(int32_t(int64_t(v) % TEXELS)); };
  auto plane = S::add(S::mul(modulo_texels<S>(x), residue(basis[4])), modulo_texels<S>(y));
  plane = S::mul(plane, residue(basis[8]));  // wraps modulo 2^32, a multiple of 64^3
  auto stored = [&](Number along) {
    auto texel = S::bit_and(S::add(plane, modulo_texels<S>(along)), S::all(int32_t(TEXELS - 1)));
    return S::add(texel, S::template shift_right<6>(texel));  // one texel more is stored per row of 64
  };
  low = stored(z), high = stored(above);
}

// Whether an octave's sums of a cell and two basis entries fit 32 bits.
inline bool is_small(const Octave& octave) {
  for (double entry : octave.lattice)
    if (entry >= 0x1p28) return false;
  return true;
}

template <class S>
inline void lattice_corners(const Octave& octave, bool far, bool small, const typename S::D (&at)[3],
                            typename S::I (&low)[4], typename S::I (&high)[4], typename S::F (&fraction)[3]) {
  typename S::D cell[3];
  for (int axis = 0; axis < 3; axis++) {
    cell[axis] = S::floor(at[axis]);
    fraction[axis] = S::to_float(S::sub(at[axis], cell[axis]));
  }
  far ? canonical_far<S>(octave.lattice, cell) : canonical<S>(octave.lattice, cell);
  if (small) {
    const typename S::I whole[3] = {S::to_int(cell[0]), S::to_int(cell[1]), S::to_int(cell[2])};
    for (int edge = 0; edge < 4; edge++) lattice_edge<S, int32_t>(octave.lattice, whole, edge, low[edge], high[edge]);
  } else {
    for (int edge = 0; edge < 4; edge++) lattice_edge<S, double>(octave.lattice, cell, edge, low[edge], high[edge]);
  }
}

template <class S> inline typename S::F mix(typename S::F from, typename S::F to, typename S::F share) {
  return S::fma(S::sub(to, from), share, from);
}

template <class S> inline typename S::F trilinear(const typename S::F (&low)[4], const typename S::F (&high)[4], const typename S::F (&fraction)[3]) {
  typename S::F edge[4];
  for (int i = 0; i < 4; i++) edge[i] = mix<S>(low[i], high[i], fraction[2]);
  return mix<S>(mix<S>(edge[0], edge[1], fraction[1]), mix<S>(edge[2], edge[3], fraction[1]), fraction[0]);
}

// Reads from a table of floats, or of bfloat16: there a texel and the next along z are one read of 32 bits.
template <class S> struct FloatTable {
  static constexpr bool coarse = false;
  static void read(const void* table, const typename S::I& at, typename S::F& low, typename S::F& high) {
    S::gather_pair(static_cast<const float*>(table), at, low, high);
  }
  static typename S::F read(const void* table, const typename S::I& at) {
    return S::gather(static_cast<const float*>(table), at);
  }
};

template <class S> struct PairTable {
  static constexpr bool coarse = true;
  static void read(const void* table, const typename S::I& at, typename S::F& low, typename S::F& high) {
    auto pair = S::gather(static_cast<const uint16_t*>(table), at);
    low = S::as_float(S::template shift_left<16>(pair));
    high = S::as_float(S::bit_and(pair, S::all(int32_t(0xffff0000))));
  }
  static typename S::F read(const void* table, const typename S::I& at) {
    return S::as_float(S::template shift_left<16>(S::gather(static_cast<const uint16_t*>(table), at)));
  }
};

template <class S, class Table, bool tiled, bool rows>
void look_up_octave(const Octave& octave, bool far, const double* x, const double* y, const double* z, int count, float* eta) {
  const bool small = tiled && is_small(octave);
  for (int first = 0; first < count; first += S::LANES) {
    typename S::D at[3];
    for (int axis = 0; axis < 3; axis++) at[axis] = locate<S, rows>(octave, axis, x + first, y + first, z + first);
    typename S::F low[4], high[4], fraction[3];
    typename S::I low_at[4], high_at[4];
    if (tiled) {
      lattice_corners<S>(octave, far, small, at, low_at, high_at, fraction);
      for (int edge = 0; edge < 4; edge++) low[edge] = Table::read(octave.table, low_at[edge]);
      for (int edge = 0; edge < 4; edge++) high[edge] = Table::read(octave.table, high_at[edge]);
    } else {
      table_corners<S, Table::coarse>(at, low_at, fraction);
      for (int edge = 0; edge < 4; edge++) Table::read(octave.table, low_at[edge], low[edge], high[edge]);
    }
    S::store(eta + first, trilinear<S>(low, high, fraction));
  }
}

// Whether products of cells and basis entries may reach 2^50 somewhere in this sweep.
inline bool is_far(const Octave& octave, const double (&farthest)[3]) {
  double cells = 0, entries = 0;
  for (int axis = 0; axis < 3; axis++) {
    double reach = std::fabs(octave.offset[axis]) + 2;
    for (int k = 0; k < 3; k++) reach += std::fabs(octave.transform[3 * axis + k]) * farthest[k];
    cells = reach > cells ? reach : cells;
  }
  for (double entry : octave.lattice) entries = std::fabs(entry) > entries ? std::fabs(entry) : entries;
  return 4 * cells * (entries + 1) >= 0x1p50;
}

template <class S, class Table> auto octave_lookup(bool tiled, bool rows) {
  if (tiled) return rows ? look_up_octave<S, Table, true, true> : look_up_octave<S, Table, true, false>;
  return rows ? look_up_octave<S, Table, false, true> : look_up_octave<S, Table, false, false>;
}

// With `pairs`, the sampler's precision may be bfloat16.
template <class S, bool pairs>
void look_up(const Sampler& sampler, const double* x, const double* y, const double* z, int count, bool rows, float* eta) {
  double farthest[3] = {0, 0, 0};
  const double* along[3] = {x, y, z};
  for (int axis = 0; axis < 3 && sampler.tiled; axis++)
    for (int i = 0; i < count; i++) farthest[axis] = std::fabs(along[axis][i]) > farthest[axis] ? std::fabs(along[axis][i]) : farthest[axis];
  auto run = octave_lookup<S, FloatTable<S>>(sampler.tiled, rows);
  if constexpr (pairs)
    if (sampler.bfloat16) run = octave_lookup<S, PairTable<S>>(sampler.tiled, rows);
  for (int i = 0; i < sampler.octaves; i++, eta += STRIDE) {
    const Octave& octave = sampler.octave[i];
    run(octave, sampler.tiled && is_far(octave, farthest), x, y, z, count, eta);
  }
}

}  // namespace
