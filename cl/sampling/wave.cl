/* A wave: what the rays of one bounce of all paths are made of, and what they found.
 *
 * Memory layout: HEADER words, then planes of 32-bit words, ray i at i of each: those of PLANES in wave.py, which says
 * what they hold. Triangles, paths and strips are whole numbers, `lit` has bytes; strips are kept where there are
 * rows of them, and of a ray that went through panes how far back it began and through how many, where there are some.
 * Words 0 and COUNT_STEP of the header count the rays and the shadow rays, on cache lines of their own. Kernels read there
 * how many there are: the host need not know. Planes are as long as a bounce may need, so that what the host maps is
 * short. Which ray a path gets may differ between runs.
 *
 * With FOLLOWED (follow.cl) a work-item keeps its path's next rays itself.
 *
 * Work-group contract: one-dimensional groups of any size, two words of local memory, barriers. Where VEC is 1 give_rays
 * and count_shadow_rays are called by all work-items of a group together, whose rays are counted by one atomic addition;
 * else by any work-item, for VEC rays at a time.
 */

#if VEC == 1
#define AS_REAL(x) as_float(x)
#define AS_WHOLE(x) as_int(x)
#define AS_BITS(x) as_uint(x)
#else
#define AS_REAL(x) JOIN(as_float, VEC)(x)
#define AS_WHOLE(x) JOIN(as_int, VEC)(x)
#define AS_BITS(x) JOIN(as_uint, VEC)(x)
#endif

/* Numbers of a ray that goes on. */
#define STRIPS_ROW 11
#define PANES_ROW (HAS_ROWS ? 12 : 11)
#define ROWS_OF_RAY (HAS_PANES ? PANES_ROW + 2 : PANES_ROW)
#define PLANE(wave, number) ((wave) + HEADER + (number) * (ulong)plane)

typedef struct {
  triple origin, direction, throughput;
  bits path;
  real density;
  whole strips;
#if HAS_PANES
  real behind, passed;
#endif
} Ray;

/* How many rays, or shadow rays, a wave has. */
uint rays_of(global const float *restrict wave) { return ((global const uint *)wave)[0]; }

uint shadow_rays_of(global const float *restrict wave) { return ((global const uint *)wave)[COUNT_STEP]; }

triple load_planes(global const float *restrict wave, const uint number, const uint plane, const uint first) {
  return (triple){LOAD(PLANE(wave, number) + first), LOAD(PLANE(wave, number + 1) + first),
                  LOAD(PLANE(wave, number + 2) + first)};
}

/* Two words that the work-items of a group share where VEC is 1. */
#if VEC == 1
#define GROUP_WORDS(name) volatile local uint name[2]
#else
#define GROUP_WORDS(name) volatile local uint *const name = 0
#endif

/* Counts so many rays more, and returns how many there were before. `words` is not restrict: compilers would keep what
 * they have read there across barriers. */
uint count_rays(const uint count, const int is_shadow, global float *restrict wave, volatile local uint *words) {
  volatile global uint *total = (volatile global uint *)wave + (is_shadow ? COUNT_STEP : 0);
#if VEC == 1
  const bool leads = get_local_id(0) == 0;
  if (leads) words[0] = 0;
  barrier(CLK_LOCAL_MEM_FENCE);
  const uint own = count > 0 ? atomic_add(words, count) : 0;
  barrier(CLK_LOCAL_MEM_FENCE);
  if (leads) words[1] = words[0] > 0 ? atomic_add(total, words[0]) : 0;
  barrier(CLK_LOCAL_MEM_FENCE);
  return words[1] + own;
#else
  (void)words;
  return count > 0 ? atomic_add(total, count) : 0;
#endif
}

#if FOLLOWED
/* Where rays go: the next one and the shadow ray of each path, those that are `alive`. */
typedef struct {
  Ray ray[2];
  whole alive[2];
} Sink;

void give_rays(const Ray *ray, const whole alive, const int is_shadow, Sink *to) {
  to->ray[is_shadow] = *ray;
  to->alive[is_shadow] = alive;
}

/* Shadow rays that are answered already. */
void count_shadow_rays(const whole is_cast, Sink *to) { to->alive[1] = is_cast; }
#else
/* Where rays go: a wave, and two words that the work-items of a group share where VEC is 1. */
typedef struct {
  uint plane;
  global float *restrict wave;
  volatile local uint *words;
} Sink;

/* Appends the rays of lanes that are alive; shadow rays leave their density and strips out. */
void give_rays(const Ray *ray, const whole alive, const int is_shadow, const Sink *to_wave) {
  const uint plane = to_wave->plane;
  global float *restrict wave = to_wave->wave;
#if VEC == 1
  const uint count = alive != 0 ? 1u : 0u;
#else
  float number[ROWS_OF_RAY][VEC];
  int is_alive[VEC];
  uint source[VEC + 1];
  STORE(alive, is_alive);
  uint count = 0;
  /* Without branches: whether a lane is alive cannot be foreseen. */
#pragma unroll
  for (uint lane = 0; lane < VEC; ++lane) {
    source[count] = lane;
    count += is_alive[lane] != 0 ? 1u : 0u;
  }
#endif
  const uint at = count_rays(count, is_shadow, wave, to_wave->words);
  if (count == 0) return;
  /* Origin and direction. */
  global float *restrict to = PLANE(wave, is_shadow ? WAVE_SHADOW_ORIGIN : WAVE_ORIGIN) + at;
  global float *restrict throughput = PLANE(wave, is_shadow ? WAVE_SHADOW_THROUGHPUT : WAVE_THROUGHPUT) + at;
  global float *restrict path = PLANE(wave, is_shadow ? WAVE_SHADOW_PATH : WAVE_PATH) + at;
  global float *restrict density = PLANE(wave, WAVE_DENSITY) + at;
  const real numbers[ROWS_OF_RAY] = {ray->origin.x,     ray->origin.y,     ray->origin.z,     ray->direction.x,
                                     ray->direction.y,  ray->direction.z,  ray->throughput.x, ray->throughput.y,
                                     ray->throughput.z, ray->density,      AS_REAL(ray->path)
#if HAS_ROWS
                                     , AS_REAL(ray->strips)
#endif
#if HAS_PANES
                                     , ray->behind, ray->passed
#endif
  };
  if (count == VEC) {
#pragma unroll
    for (uint row = 0; row < 6; ++row) STORE(numbers[row], to + row * (ulong)plane);
#pragma unroll
    for (uint row = 0; row < 3; ++row) STORE(numbers[6 + row], throughput + row * (ulong)plane);
    if (!is_shadow) STORE(numbers[9], density);
    STORE(numbers[10], path);
#if HAS_ROWS
    if (!is_shadow) STORE(numbers[STRIPS_ROW], PLANE(wave, WAVE_STRIPS) + at);
#endif
#if HAS_PANES
    if (!is_shadow) STORE(numbers[PANES_ROW], PLANE(wave, WAVE_BEHIND) + at);
    if (!is_shadow) STORE(numbers[PANES_ROW + 1], PLANE(wave, WAVE_PASSED) + at);
#endif
    return;
  }
#if VEC != 1
#pragma unroll
  for (uint row = 0; row < ROWS_OF_RAY; ++row) STORE(numbers[row], number[row]);
  for (uint i = 0; i < count; ++i) {
    const uint lane = source[i];
#pragma unroll
    for (uint row = 0; row < 6; ++row) to[row * (ulong)plane + i] = number[row][lane];
#pragma unroll
    for (uint row = 0; row < 3; ++row) throughput[row * (ulong)plane + i] = number[6 + row][lane];
    if (!is_shadow) density[i] = number[9][lane];
    path[i] = number[10][lane];
#if HAS_ROWS
    if (!is_shadow) (PLANE(wave, WAVE_STRIPS) + at)[i] = number[STRIPS_ROW][lane];
#endif
#if HAS_PANES
    if (!is_shadow) (PLANE(wave, WAVE_BEHIND) + at)[i] = number[PANES_ROW][lane];
    if (!is_shadow) (PLANE(wave, WAVE_PASSED) + at)[i] = number[PANES_ROW + 1][lane];
#endif
  }
#endif
}

/* Counts shadow rays that are answered already. */
void count_shadow_rays(const whole is_cast, const Sink *to) {
  int one[VEC];
  STORE(is_cast, one);
  uint count = 0;
#pragma unroll
  for (uint lane = 0; lane < VEC; ++lane) count += one[lane] != 0 ? 1u : 0u;
  count_rays(count, 1, to->wave, to->words);
}
#endif
