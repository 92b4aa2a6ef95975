/* What a flight was worth: true distances, paths flown, ages and errors of estimates (see docs/metrics.md). */
#include <math.h>

#include "dtsa.h"

/* Smallest squared distance of agent k to agents k+1 .. n-1. */
DTSA_SIMD
static double nearest2(int count, const double *restrict x, const double *restrict y,
                       const double *restrict z, double kx, double ky, double kz)
{
    double lane[8];
    for (int i = 0; i < 8; i++) lane[i] = 1e300;
    int j = 0;
    for (; j + 8 <= count; j += 8)
        for (int i = 0; i < 8; i++) {
            const double dx = x[j + i] - kx, dy = y[j + i] - ky, dz = z[j + i] - kz;
            const double d2 = dx * dx + dy * dy + dz * dz;
            lane[i] = d2 < lane[i] ? d2 : lane[i];
        }
    double best = 1e300;
    for (; j < count; j++) {
        const double dx = x[j] - kx, dy = y[j] - ky, dz = z[j] - kz;
        const double d2 = dx * dx + dy * dy + dz * dz;
        best = d2 < best ? d2 : best;
    }
    for (int i = 0; i < 8; i++) best = lane[i] < best ? lane[i] : best;
    return best;
}

static int nearest_index(int from, int n, const double *x, const double *y, const double *z, int k)
{
    int best = from;
    double best2 = 1e300;
    for (int j = from; j < n; j++) {
        const double dx = x[j] - x[k], dy = y[j] - y[k], dz = z[j] - z[k];
        const double d2 = dx * dx + dy * dy + dz * dz;
        if (d2 < best2) best2 = d2, best = j;
    }
    return best;
}

int metrics_distance(metrics *m, int n, int steps, int64_t slot, const double *track,
                     double collision_m)
{
    int crashed = 0;
    for (int step = 0; step < steps; step++) {
        const double *x = track + (long)step * 3 * n, *y = x + n, *z = y + n;
        for (int k = 0; k < n - 1; k++) {
            const double d2 =
                nearest2(n - k - 1, x + k + 1, y + k + 1, z + k + 1, x[k], y[k], z[k]);
            if (d2 < m->min_distance2) {
                m->min_distance2 = d2;
                m->pair[0] = k + 1;
                m->pair[1] = nearest_index(k + 1, n, x, y, z, k) + 1;
                m->min_slot = slot;
            }
            if (d2 < collision_m * collision_m) crashed = 1;
        }
        for (int k = 0; k < n; k++) {
            const double dx = x[k] - m->last_position[k], dy = y[k] - m->last_position[n + k],
                         dz = z[k] - m->last_position[2 * n + k];
            m->path[k] += sqrt(dx * dx + dy * dy + dz * dz);
            m->last_position[k] = x[k];
            m->last_position[n + k] = y[k];
            m->last_position[2 * n + k] = z[k];
        }
    }
    return crashed;
}

int metrics_arrived(int n, const double *now, const double *target, const uint8_t *moving,
                    double r_min)
{
    for (int k = 0; k < n; k++) {
        if (!moving[k]) continue;
        const double dx = now[k] - target[k], dy = now[n + k] - target[n + k],
                     dz = now[2 * n + k] - target[2 * n + k];
        if (!(sqrt(dx * dx + dy * dy + dz * dz) <= r_min)) return 0;
    }
    return 1;
}

void metrics_news(metrics *m, swarm *s, int64_t slot, const double *truth, const uint8_t *moving)
{
    const int n = s->n;
    for (int table = 0; table < s->table_count; table++) {
        const int observer = s->observer[table];
        const int64_t weight = observer < 0 ? n - 1 : 1;
        const uint8_t *ap = s->in_ap + (long)table * n;
        const int64_t *sent = s->sent_slot + (long)table * n;
        const double *p = s->est_p + (long)table * 3 * n;
        double errors = 0.0;
        swarm_estimate(s, table, slot, 0);
        for (int k = 0; k < n; k++) {
            if (!moving[k] || !ap[k] || k == observer || sent[k] < 0) continue;
            const int64_t age = slot - 1 - sent[k];
            const double dx = p[k] - truth[k], dy = p[n + k] - truth[n + k],
                         dz = p[2 * n + k] - truth[2 * n + k];
            const double error = sqrt(dx * dx + dy * dy + dz * dz);
            m->age_count += weight;
            m->age_sum += weight * age;
            if (age > m->age_max) m->age_max = age;
            errors += error;
            if (error > m->error_max) m->error_max = error;
        }
        m->error_sum += errors * (double)weight;
    }
}
