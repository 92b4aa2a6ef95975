#include "root.h"

#include <stdint.h>
#include <string.h>

#ifdef DTSA_SOFT_DOUBLES

/* x = m 4^q with a whole m of 53 or 54 bits; s, the whole root of m 2^52, has 53, and the remainder
 * says how to round. A root of single precision gives the first half of s, remainder / 2 s the rest
 * of it but for 100 units, and once more but for 2. Remainders have less than 62 bits, so their low
 * 64 bits are enough. */
double root(double x)
{
    uint64_t bits;
    memcpy(&bits, &x, sizeof bits);
    const uint32_t exponent = (uint32_t)(bits >> 52); /* with the sign */
    if (exponent - 1u >= 2046u)
        return sqrt(x); /* zero, subnormal, infinite, below zero, no number */
    const uint32_t odd = !(exponent & 1);
    const uint64_t m = ((bits & 0xfffffffffffffULL) | 1ULL << 52) << odd;
    const uint32_t first = (uint32_t)(sqrtf((float)(uint32_t)(m >> 22)) * 2048.0f);
    const float per = 1.0f / (float)first;
    const int32_t rest = (int32_t)((int64_t)(m - (uint64_t)first * first) >> 2);
    uint64_t s =
        ((uint64_t)first << 26) + (uint64_t)(int64_t)(int32_t)((float)rest * per * 0x1p27f);
    int64_t left = (int64_t)((m << 52) - s * s);
    s += (uint64_t)(int64_t)(int32_t)((float)(int32_t)(left >> 32) * per * 32.0f);
    left = (int64_t)((m << 52) - s * s);
    while (left < 0) left += (int64_t)(2 * --s + 1);
    while (left > (int64_t)(2 * s)) left -= (int64_t)(2 * s++ + 1);
    s += left > (int64_t)s;
    bits = ((uint64_t)((exponent + 1021 - odd) / 2) << 52) +
           s; /* s has the lowest bit of the exponent */
    memcpy(&x, &bits, sizeof x);
    return x;
}

#endif
