/* What a flight was worth: sums over its slots (docs/reference/metrics.md). */
#ifndef DTSA_METRICS_H
#define DTSA_METRICS_H

#include "swarm.h"

enum { METRICS_CRASHED = 1, METRICS_ARRIVED = 2, METRICS_DELAYS = 256 };

typedef struct metrics_sums {
    double min_distance2, error_sum, error_max;
    int64_t pair_1, pair_2, min_slot, age_count, age_sum, age_max;
    int64_t waking_count, waking_sum, waking_max; /* ages from waking on */
} metrics_sums;

typedef struct metrics {
    int n;
    int64_t news_from; /* ages and errors count from this slot on */
    double collision_m, r_min;
    /* Borrowed: */
    double *path;          /* (n) m, distance flown */
    double *last_position; /* (3, n) m */
    double *target;        /* (3, n) m */
    uint8_t *moving;       /* (n) */
    uint8_t *gone;         /* (n) receives nothing any more */
    double *goal;          /* (3, n) m, where each flies to now; NaN: it does not stop there */
    int64_t *woken;        /* (n) slot in which each that flies got a goal; -1: it stands */
    uint8_t *heard;        /* (n) somebody has heard it since */
    int64_t *delays; /* (METRICS_DELAYS) wakings by slots until the first frame was heard; the last:
                        or more */
    metrics_sums *sums;  /* so far */
    const double *track; /* (steps, 3, n) m, true positions in the slot that is over */
    int steps;
    swarm *tables; /* NULL: ages do not count */
} metrics;

/* A slot is over. -> METRICS_CRASHED, METRICS_ARRIVED or both. */
int metrics_update(metrics *m, int64_t slot);

#endif
