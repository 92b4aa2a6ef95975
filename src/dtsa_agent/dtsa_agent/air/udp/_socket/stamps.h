/* When datagrams arrived: the kernel's stamps are CLOCK_REALTIME, which can be set; arrivals are
 * CLOCK_MONOTONIC.
 *
 * The same is said in plain Python by StampClock in air/udp/sockets.py; tests compare the two.
 * Times are ns. */
#ifndef DTSA_STAMPS_H
#define DTSA_STAMPS_H

#include <stdint.h>

typedef struct stamp_clock {
    int64_t ahead, now; /* of CLOCK_REALTIME against CLOCK_MONOTONIC; CLOCK_MONOTONIC, both at the
                           last look */
    int usable;
    unsigned steps; /* how often CLOCK_REALTIME has been set */
} stamp_clock;

/* Datagrams have been read: looks at both clocks. */
void stamps_look(stamp_clock *s);
void stamps_looked(stamp_clock *s, int64_t ahead, int64_t now);
/* stamp < 0: the kernel has given none. */
int64_t stamps_arrival(const stamp_clock *s, int64_t stamp);

#endif
