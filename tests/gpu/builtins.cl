/* OpenCL's built-in functions by those of NVIDIA's libdevice, for compiling kernels where no NVIDIA driver is.
 *
 * Declared as clang's own opencl-c header has them; joined to a kernel's text as bitcode (nvidia.py). Only what the
 * kernels call is here: what is missing is an error of ptxas, which names it.
 *
 * Work-group contract: none.
 */

#define O __attribute__((overloadable))
float __nv_fmaf(float, float, float); double __nv_fma(double, double, double);
float __nv_fabsf(float); double __nv_fabs(double); float __nv_fmaxf(float, float); float __nv_fminf(float, float);
double __nv_fmax(double, double); double __nv_fmin(double, double); float __nv_copysignf(float, float);
float __nv_expf(float); float __nv_exp2f(float); float __nv_logf(float); float __nv_log2f(float); float __nv_powf(float, float);
float __nv_sinf(float); float __nv_cosf(float); float __nv_acosf(float); float __nv_atan2f(float, float);
float __nv_floorf(float); float __nv_rintf(float); void __nv_sincosf(float, float *, float *);
float __nv_ldexpf(float, int); double __nv_ldexp(double, int); int __nv_ilogb(double); int __nv_umulhi(int, int);
#define SREG(d, name) ((d) == 0 ? __nvvm_read_ptx_sreg_##name##_x() : (d) == 1 ? __nvvm_read_ptx_sreg_##name##_y() : __nvvm_read_ptx_sreg_##name##_z())
size_t O get_local_id(uint d) { return SREG(d, tid); }
size_t O get_local_size(uint d) { return SREG(d, ntid); }
size_t O get_group_id(uint d) { return SREG(d, ctaid); }
size_t O get_num_groups(uint d) { return SREG(d, nctaid); }
size_t O get_global_offset(uint d) { uint x = 0; if (d == 0) __asm__("mov.u32 %0, %%envreg3;" : "=r"(x)); return x; }
size_t O get_global_id(uint d) { return get_group_id(d) * get_local_size(d) + get_local_id(d) + get_global_offset(d); }
size_t O get_global_size(uint d) { return get_num_groups(d) * get_local_size(d); }
void O barrier(cl_mem_fence_flags f) { __syncthreads(); }
float O fma(float a, float b, float c) { return __nv_fmaf(a, b, c); }
double O fma(double a, double b, double c) { return __nv_fma(a, b, c); }
float O fabs(float a) { return __nv_fabsf(a); }
float3 O fabs(float3 a) { return (float3)(__nv_fabsf(a.x), __nv_fabsf(a.y), __nv_fabsf(a.z)); }
#define BOTH3(name) float3 O name(float3 a, float3 b) { return (float3)(name(a.x, b.x), name(a.y, b.y), name(a.z, b.z)); }
double O fabs(double a) { return __nv_fabs(a); }
float O max(float a, float b) { return __nv_fmaxf(a, b); }
float O min(float a, float b) { return __nv_fminf(a, b); }
float O fmax(float a, float b) { return __nv_fmaxf(a, b); }
float O fmin(float a, float b) { return __nv_fminf(a, b); }
double O fmax(double a, double b) { return __nv_fmax(a, b); }
double O fmin(double a, double b) { return __nv_fmin(a, b); }
double O max(double a, double b) { return __nv_fmax(a, b); }
double O min(double a, double b) { return __nv_fmin(a, b); }
BOTH3(fmax) BOTH3(fmin) BOTH3(max) BOTH3(min)
float4 O mix(float4 a, float4 b, float t) { return a + (b - a) * t; }
float O clamp(float x, float a, float b) { return __nv_fminf(__nv_fmaxf(x, a), b); }
int O all(int4 a) { return (a.x & a.y & a.z & a.w) < 0; }
int O min(int a, int b) { return a < b ? a : b; }
int O max(int a, int b) { return a > b ? a : b; }
uint O min(uint a, uint b) { return a < b ? a : b; }
uint O max(uint a, uint b) { return a > b ? a : b; }
int O clamp(int x, int a, int b) { return x < a ? a : x > b ? b : x; }
uint O clamp(uint x, uint a, uint b) { return x < a ? a : x > b ? b : x; }
float O copysign(float a, float b) { return __nv_copysignf(a, b); }
float O sqrt(float a) { return __builtin_sqrtf(a); }
float2 O sqrt(float2 a) { return (float2)(sqrt(a.x), sqrt(a.y)); }
float4 O sqrt(float4 a) { return (float4)(sqrt(a.lo), sqrt(a.hi)); }
float8 O sqrt(float8 a) { return (float8)(sqrt(a.lo), sqrt(a.hi)); }
float O rsqrt(float a) { return __nvvm_rsqrt_approx_f(a); }
float O exp(float a) { return __nv_expf(a); }
float O exp2(float a) { return __nv_exp2f(a); }
float O log(float a) { return __nv_logf(a); }
float O log2(float a) { return __nv_log2f(a); }
float O pow(float a, float b) { return __nv_powf(a, b); }
float O sin(float a) { return __nv_sinf(a); }
float O cos(float a) { return __nv_cosf(a); }
float O acos(float a) { return __nv_acosf(a); }
float O atan2(float a, float b) { return __nv_atan2f(a, b); }
float O floor(float a) { return __nv_floorf(a); }
float O rint(float a) { return __nv_rintf(a); }
float O sincos(float a, float *c) { float s; __nv_sincosf(a, &s, c); return s; }
float O ldexp(float a, int k) { return __nv_ldexpf(a, k); }
double O ldexp(double a, int k) { return __nv_ldexp(a, k); }
int O ilogb(double a) { return __nv_ilogb(a); }
int O isfinite(float a) { return __builtin_isfinite(a); }
int O isfinite(double a) { return __builtin_isfinite(a); }
uint O clz(uint a) { return a ? (uint)__builtin_clz(a) : 32u; }
uint O popcount(uint a) { return (uint)__builtin_popcount(a); }
uint O mul_hi(uint a, uint b) { return (uint)__nv_umulhi((int)a, (int)b); }
float O convert_float(uint a) { return (float)a; }
float O convert_float(int a) { return (float)a; }
uint O convert_uint(float a) { return (uint)a; }
uint O convert_uint(int a) { return (uint)a; }
int O convert_int(float a) { return (int)a; }
int O convert_int(uint a) { return (int)a; }
double O convert_double(float a) { return (double)a; }
float4 O vload_half4(size_t n, const global half *p) {
  p += 4 * n;
  return (float4)(__builtin_load_halff(p), __builtin_load_halff(p + 1), __builtin_load_halff(p + 2),
                  __builtin_load_halff(p + 3));
}
float3 O vload3(size_t n, const global float *p) { p += 3 * n; return (float3)(p[0], p[1], p[2]); }
void O vstore3(float3 v, size_t n, global float *p) { p += 3 * n; p[0] = v.x; p[1] = v.y; p[2] = v.z; }
/* Of four bytes' alignment: ptxas may not merge them either. */
#define WIDE(n) typedef float##n __attribute__((aligned(4))) loose##n; \
  float##n O vload##n(size_t i, const global float *p) { return *(const global loose##n *)(p + n * i); } \
  float##n O vload##n(size_t i, const float *p) { return *(const loose##n *)(p + n * i); } \
  void O vstore##n(float##n v, size_t i, global float *p) { *(global loose##n *)(p + n * i) = v; } \
  void O vstore##n(float##n v, size_t i, float *p) { *(loose##n *)(p + n * i) = v; }
WIDE(2) WIDE(4) WIDE(8)
float O dot(float3 a, float3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
float3 O cross(float3 a, float3 b) { return a.yzx * b.zxy - a.zxy * b.yzx; }
float3 O normalize(float3 a) { return a * rsqrt(dot(a, a)); }
int O atomic_inc(volatile global int *p) { return __sync_fetch_and_add(p, 1); }
uint O atomic_inc(volatile global uint *p) { return __sync_fetch_and_add(p, 1); }
int O atomic_add(volatile global int *p, int v) { return __sync_fetch_and_add(p, v); }
uint O atomic_add(volatile global uint *p, uint v) { return __sync_fetch_and_add(p, v); }
uint O atomic_add(volatile local uint *p, uint v) { return __sync_fetch_and_add(p, v); }
int O atomic_or(volatile global int *p, int v) { return __sync_fetch_and_or(p, v); }
int O atomic_or(volatile local int *p, int v) { return __sync_fetch_and_or(p, v); }
