// Opening samplers, choosing a path, and walking through points and voxels.
#include "kernel.h"

#include <cmath>
#include <cstdlib>
#include <cstring>
#include <new>

#include "sampler.hpp"

#if defined(__x86_64__)
#include <cpuid.h>
#include <immintrin.h>
#if defined(__linux__)
#include <sys/syscall.h>
#include <unistd.h>
#endif
#endif
#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace {

#if defined(__x86_64__)
bool has_avx512bf16() {
  unsigned a, b, c, d;
  return __get_cpuid_count(7, 1, &a, &b, &c, &d) && a >> 5 & 1;
}

// Whether AMX is there, with bfloat16, and the system lets this process use it.
bool has_amx() {
#if defined(__linux__)
  unsigned a, b, c, d;
  if (!__get_cpuid_count(7, 0, &a, &b, &c, &d) || !(d >> 22 & 1) || !(d >> 24 & 1)) return false;
  constexpr int request_permission = 0x1023, tile_data = 18;
  return syscall(SYS_arch_prctl, request_permission, tile_data) == 0;
#else
  return false;
#endif
}

bool runs(const Path& path) {
  static const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  static const bool avx512 = avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
                             __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl");
  static const bool avx512bf16 = avx512 && has_avx512bf16();
  static const bool amx = avx512bf16 && has_amx();  // it converts by AVX-512 BF16
  const auto is = [&](const char* name) { return !strcmp(path.name, name); };
  return is("amx") ? amx : is("avx512bf16") ? avx512bf16 : is("avx512") ? avx512 : is("avx2") ? avx2 : true;
}
#else
bool runs(const Path&) { return true; }
#endif

const Path* const paths[] = {
#if SOLIDGRAIN_AMX
    &amx_path,
#endif
#if SOLIDGRAIN_AVX512BF16
    &avx512bf16_path,
#endif
#if defined(__x86_64__)
    &avx512_path,     &avx2_path,
#endif
    &portable_path,
};

const Path* find_path(const char* name) {
  for (const Path* path : paths)
    if (!strcmp(path->name, name) && runs(*path)) return path;
  return nullptr;
}

size_t aligned(size_t bytes, size_t alignment = ALIGNMENT) { return (bytes + alignment - 1) / alignment * alignment; }

// Large blocks on large pages where the system has them: the gathers would miss the page tables otherwise.
void* allocate(size_t bytes) {
  constexpr size_t large_page = size_t(2) << 20;
  const size_t alignment = bytes >= large_page ? large_page : ALIGNMENT;
  void* block = nullptr;
  if (posix_memalign(&block, alignment, aligned(bytes, alignment))) return nullptr;
#if defined(__linux__)
  if (alignment == large_page) madvise(block, aligned(bytes, alignment), MADV_HUGEPAGE);
#endif
  return block;
}

size_t table_bytes(bool bfloat16) { return aligned((bfloat16 ? 2 : 4) * TABLE); }

// The table [64, 64, 64] as [64, 64, 65] floats or bfloat16.
void fill_table(const float* noise, bool bfloat16, void* table) {
  for (int row = 0; row < RESOLUTION * RESOLUTION; row++, noise += RESOLUTION)
    for (int z = 0; z < ROW; z++) {
      const float texel = noise[z % RESOLUTION];
      const int at = row * ROW + z;
      if (bfloat16)
        static_cast<uint16_t*>(table)[at] = uint16_t(round_to_bfloat16(texel));
      else
        static_cast<float*>(table)[at] = texel;
    }
}

// The numbers of layer l and where its weights begin; returns where the next layer's do.
const float* describe(const Sampler& sampler, int l, const float* weights, Layer& layer) {
  layer.units = l == 0 ? 0 : sampler.width;
  layer.octaves = l < 4 ? sampler.octaves / 4 : 0;
  layer.outputs = l == sampler.hidden_layers ? 3 : sampler.width;
  layer.bias = weights;
  layer.weights = weights + layer.outputs;
  return layer.weights + size_t(layer.units + layer.octaves) * layer.outputs;
}

// The memory of one call: a sweep's coordinates, noise and colours, and what the path needs.
struct Workspace {
  char* memory;
  double *x, *y, *z;  // [STRIDE]
  float *eta;         // [octaves, STRIDE]
  float *rgb;         // [SWEEP, 3]
  void* scratch;

  explicit Workspace(const Sampler& sampler) {
    const size_t places = sizeof(double) * 3 * STRIDE, noise = sizeof(float) * STRIDE * sampler.octaves;
    const size_t colors = aligned(sizeof(float) * 3 * SWEEP);
    memory = static_cast<char*>(allocate(places + noise + colors + sampler.path->scratch_bytes(sampler)));
    x = reinterpret_cast<double*>(memory), y = x + STRIDE, z = y + STRIDE;
    eta = reinterpret_cast<float*>(memory + places);
    rgb = reinterpret_cast<float*>(memory + places + noise);
    scratch = memory + places + noise + colors;
  }
  ~Workspace() { free(memory); }
  Workspace(const Workspace&) = delete;

  // Colours of the first `count` places, clipped to [0, 1]; with `rows`, each 16 share y and z. Returns the first that is not
  // finite, or -1.
  int64_t evaluate(const Sampler& sampler, int count, bool rows) {
    const int padded = (count + PADDING - 1) / PADDING * PADDING;
    for (int i = count; i < padded; i++) x[i] = x[count - 1], y[i] = y[count - 1], z[i] = z[count - 1];
    sampler.path->look_up(sampler, x, y, z, padded, rows, eta);
    sampler.path->perceive(sampler, eta, count, rgb, scratch);
    int64_t wrong = -1;
    for (int i = 3 * count - 1; i >= 0; i--) {
      if (!std::isfinite(rgb[i])) wrong = i / 3;
      rgb[i] = rgb[i] < 0 ? 0 : rgb[i] > 1 ? 1 : rgb[i];
    }
    return wrong;
  }
};

// How a grid is cut: bricks of up to SWEEP voxels, as near to cubes as the grid's shape allows, whole rows of 16 where it can.
struct Bricks {
  int64_t size[3], count[3];  // x, y, z

  Bricks(int64_t columns, int64_t rows, int64_t planes) {
    size[2] = planes < 16 ? planes : 16;
    int64_t across = SWEEP / size[2], height = 16;
    while (height * height * 4 <= across) height *= 2;
    size[1] = rows < height ? rows : height;
    size[0] = across / size[1];
    if (size[0] > 16) size[0] -= size[0] % 16;
    count[0] = (columns + size[0] - 1) / size[0];
    count[1] = (rows + size[1] - 1) / size[1];
    count[2] = (planes + size[2] - 1) / size[2];
  }
  int64_t all() const { return count[0] * count[1] * count[2]; }
};

int64_t least(int64_t a, int64_t b) { return a < b ? a : b; }

}  // namespace

int32_t solidgrain_abi() { return SOLIDGRAIN_ABI; }

const char* solidgrain_paths() {
  static const struct Names {
    char text[64] = "";
    Names() {
      for (const Path* path : paths)
        if (runs(*path)) strcat(strcat(text, *text ? "," : ""), path->name);
    }
  } names;
  return names.text;
}

Sampler* solidgrain_open(const SamplerDescription* given, const char* path_name) {
  const Path* path = find_path(path_name);
  if (!path || (given->bfloat16 && !path->bfloat16)) return nullptr;
  if (given->octaves % 8 || given->octaves < 8 || given->octaves > 128 || given->width % 16 || given->width < 16 || given->hidden_layers < 4)
    return nullptr;
  Sampler sampler{path, given->octaves, given->width, given->hidden_layers, given->bfloat16 != 0, given->tiled != 0, nullptr, nullptr};

  // One block of memory: the sampler, its octaves and layers, packed weights, tables.
  const size_t heads = aligned(sizeof(Sampler)) + aligned(sizeof(Octave) * sampler.octaves) + aligned(sizeof(Layer) * (sampler.hidden_layers + 1));
  size_t bytes = heads;
  const float* weights = given->weights;
  for (int l = 0; l <= sampler.hidden_layers; l++) {
    Layer layer{};
    weights = describe(sampler, l, weights, layer);
    bytes += aligned(path->packed_bytes(sampler, layer));
  }
  const size_t table = table_bytes(sampler.bfloat16);
  char* memory = static_cast<char*>(allocate(bytes + table * sampler.octaves));
  if (!memory) return nullptr;

  sampler.octave = reinterpret_cast<Octave*>(memory + aligned(sizeof(Sampler)));
  sampler.layer = reinterpret_cast<Layer*>(reinterpret_cast<char*>(sampler.octave) + aligned(sizeof(Octave) * sampler.octaves));
  char* packed = memory + heads;
  weights = given->weights;
  for (int l = 0; l <= sampler.hidden_layers; l++) {
    Layer& layer = sampler.layer[l];
    weights = describe(sampler, l, weights, layer);
    path->pack(sampler, layer, packed);
    layer.packed = packed;
    layer.bias = layer.weights = nullptr;  // the caller's, gone after this
    packed += aligned(path->packed_bytes(sampler, layer));
  }
  for (int i = 0; i < sampler.octaves; i++, packed += table) {
    Octave& octave = sampler.octave[i];
    memcpy(octave.transform, given->transforms + 9 * i, sizeof octave.transform);
    memcpy(octave.offset, given->offsets + 3 * i, sizeof octave.offset);
    memcpy(octave.lattice, given->lattice + 9 * i, sizeof octave.lattice);
    fill_table(given->noise + TEXELS * i, sampler.bfloat16, packed);
    octave.table = packed;
  }
  return new (memory) Sampler(sampler);
}

void solidgrain_close(Sampler* sampler) { free(sampler); }

int64_t solidgrain_points(const Sampler* sampler, const double* points, int64_t count, float* rgb) {
  Workspace space(*sampler);
  if (!space.memory) return -2;
  for (int64_t first = 0; first < count; first += SWEEP) {
    const int now = int(least(SWEEP, count - first));
    for (int i = 0; i < now; i++) {
      const double* point = points + 3 * (first + i);
      space.x[i] = point[0], space.y[i] = point[1], space.z[i] = point[2];
    }
    const int64_t wrong = space.evaluate(*sampler, now, false);
    if (wrong >= 0) return first + wrong;
    memcpy(rgb + 3 * first, space.rgb, sizeof(float) * 3 * now);
  }
  return -1;
}

int64_t solidgrain_bricks(int64_t columns, int64_t rows, int64_t planes) { return Bricks(columns, rows, planes).all(); }

int64_t solidgrain_grid(const Sampler* sampler, const double* x, int64_t columns, const double* y, int64_t rows,
                        const double* z, int64_t planes, int64_t first, int64_t count, float* rgb) {
  const Bricks bricks(columns, rows, planes);
  Workspace space(*sampler);
  if (!space.memory) return -2;
  for (int64_t brick = first; brick < first + count; brick++) {
    const int64_t left = brick % bricks.count[0] * bricks.size[0];
    const int64_t top = brick / bricks.count[0] % bricks.count[1] * bricks.size[1];
    const int64_t front = brick / bricks.count[0] / bricks.count[1] * bricks.size[2];
    const int64_t width = least(bricks.size[0], columns - left), height = least(bricks.size[1], rows - top);
    const int64_t depth = least(bricks.size[2], planes - front);
    int i = 0;
    for (int64_t c = 0; c < depth; c++)
      for (int64_t b = 0; b < height; b++)
        for (int64_t a = 0; a < width; a++, i++) space.x[i] = x[left + a], space.y[i] = y[top + b], space.z[i] = z[front + c];
    const int64_t wrong = space.evaluate(*sampler, i, width % 16 == 0);
    auto place = [&](int64_t row) { return ((front + row / height) * rows + top + row % height) * columns + left; };
    if (wrong >= 0) return place(wrong / width) + wrong % width;
    for (int64_t row = 0; row < depth * height; row++)
      memcpy(rgb + 3 * place(row), space.rgb + 3 * row * width, sizeof(float) * 3 * width);
  }
  return -1;
}
