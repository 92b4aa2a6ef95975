/* What a flight was worth: sums over its slots (docs/metrics.md). */
#ifndef DTSA_METRICS_H
#define DTSA_METRICS_H

#include "swarm.h"

enum { METRICS_CRASHED = 1, METRICS_ARRIVED = 2 };

/* Eight bytes each, in this order: dtsa_bench/metrics.py reads them. */
typedef struct metrics_sums {
    double min_distance2, error_sum, error_max;
    int64_t pair_1, pair_2, min_slot, age_count, age_sum, age_max;
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
    metrics_sums *sums;    /* so far */
} metrics;

/* A slot is over. track: (steps, 3, n) m; tables: NULL: ages do not count. -> METRICS_CRASHED, METRICS_ARRIVED or both. */
int metrics_update(metrics *m, int64_t slot, int steps, const double *track, swarm *tables);

#endif
