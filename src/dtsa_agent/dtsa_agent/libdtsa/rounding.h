/* Every multiplication and every addition is rounded: fused ones give other bits on processors that
 * have them. The first thing that a file of this library includes, whatever flags the program has
 * that it becomes a part of. */
#ifndef DTSA_ROUNDING_H
#define DTSA_ROUNDING_H

#ifdef __FAST_MATH__
#error "libdtsa gives all agents the same bits: compile it without -ffast-math"
#endif

#ifdef __clang__
#pragma STDC FP_CONTRACT OFF
#elif defined(__ARM_FEATURE_FMA) || defined(__FP_FAST_FMA) || defined(__FP_FAST_FMAF)
#pragma GCC optimize("fp-contract=off") /* GCC ignores the standard's pragma */
#endif

#endif
