/* Four doubles at a time, in plain C with GCC's and clang's vector extensions: the same source is
 * compiled for the baseline and for AVX2, every lane is an IEEE operation of its own, and sums over
 * lanes have one fixed order. */
#ifndef DTSA_AVOIDER_SIMD_H
#define DTSA_AVOIDER_SIMD_H

#include "rounding.h"

#include <math.h>
#include <stdint.h>
#include <string.h>

#if defined(__SSE2__)
#include <emmintrin.h>
#endif

/* Everything below is inlined into its callers, so no vector is ever passed by an ABI that could
 * differ. */
#pragma GCC diagnostic ignored "-Wpsabi"

#define AVOID_INLINE static inline __attribute__((always_inline))

#if defined(__x86_64__) && (defined(__GNUC__) || defined(__clang__))
#define AVOID_HAVE_AVX2 1
#define AVOID_AVX2 __attribute__((target("avx2")))
#else
#define AVOID_HAVE_AVX2 0
#define AVOID_AVX2
#endif

#define LANES 4

typedef double v4d __attribute__((vector_size(32)));
typedef int64_t v4i __attribute__((vector_size(32)));
typedef double v4d_any __attribute__((vector_size(32), aligned(8), may_alias));

AVOID_INLINE v4d v4_load(const double *from) { return *(const v4d_any *)from; }

AVOID_INLINE void v4_store(double *to, v4d x) { *(v4d_any *)to = x; }

AVOID_INLINE v4d v4_all(double x) { return (v4d){x, x, x, x}; }

/* mask ? a : b, lane by lane (a mask is all ones or all zeros). */
AVOID_INLINE v4d v4_select(v4i mask, v4d a, v4d b)
{
    return (v4d)((mask & (v4i)a) | (~mask & (v4i)b));
}

/* mask ? a : +0 */
AVOID_INLINE v4d v4_keep(v4i mask, v4d a) { return (v4d)(mask & (v4i)a); }

AVOID_INLINE v4d v4_max(v4d a, v4d b) { return v4_select(a > b, a, b); }

AVOID_INLINE v4d v4_min(v4d a, v4d b) { return v4_select(a < b, a, b); }

/* Compilers make one instruction of it (no errno). */
AVOID_INLINE v4d v4_sqrt(v4d x) { return (v4d){sqrt(x[0]), sqrt(x[1]), sqrt(x[2]), sqrt(x[3])}; }

/* Bit l is set where lane l of the mask is. */
AVOID_INLINE int v4_bits(v4i mask)
{
#if defined(__SSE2__)
    const v4d m = (v4d)mask;
    const __m128d low = {m[0], m[1]}, high = {m[2], m[3]};
    return _mm_movemask_ps(_mm_shuffle_ps(_mm_castpd_ps(low), _mm_castpd_ps(high), 0xDD));
#else
    return (int)((mask[0] & 1) | (mask[1] & 2) | (mask[2] & 4) | (mask[3] & 8));
#endif
}

/* The one order in which lanes are summed. */
AVOID_INLINE double v4_sum(v4d x) { return (x[0] + x[2]) + (x[1] + x[3]); }

#endif
