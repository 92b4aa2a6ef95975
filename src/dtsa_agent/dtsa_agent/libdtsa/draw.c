/* Draws that look random: the same for everybody who asks the same, on every machine. */
#include "core.h"

uint64_t mix64(uint64_t x)
{
    x += 0x9e3779b97f4a7c15ULL;
    x = (x ^ x >> 30) * 0xbf58476d1ce4e5b9ULL;
    x = (x ^ x >> 27) * 0x94d049bb133111ebULL;
    return x ^ x >> 31;
}

double draw_uniform(uint64_t key, uint64_t what)
{
    return (double)(mix64(key ^ mix64(what)) >> 11) * 0x1p-53;
}
