/* The square root of a double where doubles are software: the same bits as sqrt, by the roots of
 * single precision that such processors have. Compile with -DDTSA_SOFT_DOUBLES to have it, and all
 * else that saves operations there, anywhere. */
#ifndef DTSA_ROOT_H
#define DTSA_ROOT_H

#include "rounding.h"

#include <math.h>

#if !defined(DTSA_SOFT_DOUBLES) && defined(__ARM_FP) && !(__ARM_FP & 8)
#define DTSA_SOFT_DOUBLES
#endif

#ifdef DTSA_SOFT_DOUBLES
double root(double x);
#else
static inline double root(double x) { return sqrt(x); }
#endif

#endif
