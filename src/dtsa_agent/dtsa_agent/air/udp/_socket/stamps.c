/* When datagrams arrived, by the kernel's stamps. */
#include "stamps.h"

#include <time.h>

static const int64_t SECOND = 1000000000;
static const int64_t EXACT =
    2000; /* between two looks at one clock: good enough for the other one in between */
static const int64_t STEP =
    1000000; /* the clock of the stamps has been set if it moved by this between two looks */
static const int64_t OLDEST =
    60000000000; /* a stamp cannot be older than the longest sleep of a process */

static int64_t read_clock(clockid_t which)
{
    struct timespec t;
    clock_gettime(which, &t);
    return (int64_t)t.tv_sec * SECOND + t.tv_nsec;
}

void stamps_looked(stamp_clock *s, int64_t ahead, int64_t now)
{
    const int64_t moved = ahead - s->ahead;
    s->usable = moved >= -STEP && moved <= STEP;
    s->steps += !s->usable;
    s->ahead = ahead;
    s->now = now;
}

/* Both clocks, the best of three looks. */
void stamps_look(stamp_clock *s)
{
    int64_t ahead = 0, now = 0, best = INT64_MAX;
    for (int look = 0; look < 3 && best >= EXACT; look++) {
        const int64_t before = read_clock(CLOCK_MONOTONIC), real = read_clock(CLOCK_REALTIME);
        const int64_t after = read_clock(CLOCK_MONOTONIC);
        if (after - before >= best) continue;
        best = after - before;
        ahead = real - (before + after) / 2; /* CLOCK_MONOTONIC is never negative */
        now = after;
    }
    stamps_looked(s, ahead, now);
}

int64_t stamps_arrival(const stamp_clock *s, int64_t stamp)
{
    if (stamp < 0 || !s->usable) return s->now;
    const int64_t arrival = stamp - s->ahead;
    return arrival - s->now > -OLDEST && arrival <= s->now ? arrival : s->now;
}
