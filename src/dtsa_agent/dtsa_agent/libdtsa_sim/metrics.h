/* What a flight was worth, and when it is over (docs/reference/metrics.md). */
#ifndef DTSA_METRICS_H
#define DTSA_METRICS_H

#include "swarm.h"

enum { METRICS_FLIES, METRICS_COMPLETED, METRICS_CRASHED, METRICS_TIMED_OUT }; /* ends */

typedef struct metrics {
    int n, stop_on_crash;
    int64_t news_from; /* ages and errors count from this slot on */
    double collision_m, r_min;
    int64_t tail;   /* slots that a complete flight flies on */
    int64_t limit;  /* slots after which it is over */
    course *course; /* of all agents; NULL: no plan */
    /* Borrowed: */
    double *path;          /* (n) m, distance flown */
    double *last_position; /* (3, n) m */
    double *target;        /* (3, n) m */
    uint8_t *flies;        /* (n) moves at all */
    uint8_t *moving;       /* (n) of those, has to arrive: has never been lost */
    uint8_t *lost;         /* (n) fell out of the flight: receives nothing any more */
    double *goal;          /* (3, n) m, where each flies to now; NaN: it does not stop there */
    int64_t *woken;        /* (n) slot in which each that flies got a goal; -1: it stands */
    uint8_t *heard;        /* (n) some agent has heard it since */
    int64_t *delays;       /* (n goals) slots from each waking that was heard to the first frame */
    const double *track;   /* (steps, 3, n) m, true positions in the slot that is over */
    int steps;
    int waits;     /* movers that came back are not at their targets: the flight is not complete */
    swarm *tables; /* NULL: ages do not count */

    /* So far. */
    int end; /* METRICS_ */
    int64_t slots, outcomes[3], frames;
    int64_t completion_slot, crash_slot, crash_1, crash_2; /* -1: not yet; ids */
    int64_t compared, split, torn, split_slot; /* slots: tables compared, unequal, choices too */
    double min_distance2, error_sum, error_max;
    int64_t pair_1, pair_2, min_slot, age_count, age_sum, age_max;
    int64_t waking_count, waking_sum, waking_max; /* ages from waking on */
    int64_t wakings, wakings_heard;
} metrics;

/* Before the first slot: those that fly at once get their goals. */
void metrics_start(metrics *m);
/* What some agents believe at the start of a slot: (count) digests of tables, ids chosen. */
void metrics_compare(metrics *m, int64_t slot, int count, const uint32_t *digest,
                     const uint16_t *chosen);
/* A slot is over. -> why the flight is, METRICS_. */
int metrics_update(metrics *m, int64_t slot, int outcome);

#endif
