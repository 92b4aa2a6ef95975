/* The clock of an agent in real time over ROS. */
#ifndef DTSA_TIMEBASE_H
#define DTSA_TIMEBASE_H

#include "dtsa_station.h"

/* ---- which slot it is, where no channel says so ---- */

enum { DTSA_ALIGN_MAX = 15 };

/* Turns arrival offsets of heard frames into small shifts of the own slots: after every
 * `receptions` usable ones by `share` / 65536 of their median. */
typedef struct dtsa_aligner {
    int receptions;   /* 1 .. DTSA_ALIGN_MAX; 9 */
    int32_t share;    /* 1 .. 65536; 32768 */
    int64_t limit_ns; /* offsets beyond this are ignored; 1,000,000 */
    int count;        /* offsets so far, ascending */
    int64_t offsets[DTSA_ALIGN_MAX];
    uint32_t corrections, ignored, ignored_in_a_row;
} dtsa_aligner;

/* By how much the own slots move now, ns (0 most of the time). offset_ns: when a frame arrived
 * minus when the own clock expected it. */
DTSA_API int64_t dtsa_align(dtsa_aligner *aligner, int64_t offset_ns);
DTSA_API void dtsa_align_reset(dtsa_aligner *aligner);

enum {
    DTSA_ALIGNED,   /* of the same time; the own slots may have moved a little */
    DTSA_RESTARTED, /* its time was taken over; the agent has to restart */
    DTSA_FOREIGN    /* of an earlier time: its sender will come to us */
};

typedef struct dtsa_timebase {
    int64_t slot_ns, round_ns, wait_ns, deadline_ns;
    int64_t origin_ns; /* start of slot 0 by the own clock */
    int state;         /* DTSA_LISTENING, DTSA_ALONE, DTSA_JOINED */
    uint32_t restarts;
    dtsa_aligner aligner;
} dtsa_timebase;

/* A time base that does not run yet. Returns 0 if a value is below 1. */
DTSA_API int dtsa_timebase_init(dtsa_timebase *base, int agents, int anchor_every, int64_t slot_ns,
                                int id, uint64_t seed);
/* Begins to listen; returns when to call dtsa_timebase_wake at the latest, ns. */
DTSA_API int64_t dtsa_timebase_start(dtsa_timebase *base, int64_t now_ns);
/* Whether slots begin now because nothing has been heard for long; 1 once. */
DTSA_API int dtsa_timebase_wake(dtsa_timebase *base, int64_t now_ns);
/* The slot at a time, and when a slot starts. Not while listening. */
DTSA_API int64_t dtsa_timebase_slot(const dtsa_timebase *base, int64_t now_ns);
DTSA_API int64_t dtsa_timebase_slot_start(const dtsa_timebase *base, int64_t slot);
/* A frame of `slot` whose transmission started at start_ns. */
DTSA_API int dtsa_timebase_hear(dtsa_timebase *base, int64_t slot, int64_t start_ns);

#endif
