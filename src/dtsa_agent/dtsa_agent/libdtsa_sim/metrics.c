/* What a flight was worth: true distances, paths flown, ages and errors of estimates (see
 * docs/reference/metrics.md). */
#include <math.h>

#include "metrics.h"

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

/* Paths flown and the smallest distance; -> whether two agents are closer than `collision_m`. */
static int distances(metrics *m, int64_t slot)
{
    const int n = m->n;
    metrics_sums *sum = m->sums;
    int crashed = 0;
    for (int step = 0; step < m->steps; step++) {
        const double *x = m->track + (long)step * 3 * n, *y = x + n, *z = y + n;
        for (int k = 0; k < n - 1; k++) {
            const double d2 =
                nearest2(n - k - 1, x + k + 1, y + k + 1, z + k + 1, x[k], y[k], z[k]);
            if (d2 < sum->min_distance2) {
                sum->min_distance2 = d2;
                sum->pair_1 = k + 1;
                sum->pair_2 = nearest_index(k + 1, n, x, y, z, k) + 1;
                sum->min_slot = slot;
            }
            if (d2 < m->collision_m * m->collision_m) crashed = 1;
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

/* Whether all moving agents are within `r_min` of their targets. */
static int arrived(const metrics *m, const double *now)
{
    const int n = m->n;
    const double *target = m->target;
    for (int k = 0; k < n; k++) {
        if (!m->moving[k]) continue;
        const double dx = now[k] - target[k], dy = now[n + k] - target[n + k],
                     dz = now[2 * n + k] - target[2 * n + k];
        if (!(sqrt(dx * dx + dy * dy + dz * dz) <= m->r_min)) return 0;
    }
    return 1;
}

/* Ages and errors in one table. */
static void table_news(metrics *m, const dtsa_table *t, int64_t slot, const double *truth)
{
    const int n = m->n, observer = t->observer;
    const int64_t weight = observer < 0 ? n - 1 : 1;
    const uint8_t *ap = t->in_ap, *moving = m->moving;
    const int64_t *sent = t->sent_slot;
    const double *p = t->est_p;
    metrics_sums *sum = m->sums;
    double errors = 0.0;
    for (int k = 0; k < n; k++) {
        if (!moving[k] || !ap[k] || k == observer || sent[k] < 0) continue;
        const int64_t age = slot - 1 - sent[k];
        const double dx = p[k] - truth[k], dy = p[n + k] - truth[n + k],
                     dz = p[2 * n + k] - truth[2 * n + k];
        const double error = sqrt(dx * dx + dy * dy + dz * dz);
        sum->age_count += weight;
        sum->age_sum += weight * age;
        if (age > sum->age_max) sum->age_max = age;
        errors += error;
        if (error > sum->error_max) sum->error_max = error;
    }
    sum->error_sum += errors * (double)weight;
}

static void news(metrics *m, swarm *s, int64_t slot, const double *truth)
{
    for (int table = 0; table < s->table_count; table++) {
        swarm_estimate(s, table, slot, 0);
        table_news(m, &s->tables[table], slot, truth);
    }
}

/* Ages from waking on in one table: of all that fly, heard or not. */
static void table_wakings(metrics *m, const dtsa_table *t, int64_t last)
{
    const int n = m->n, observer = t->observer;
    if (observer >= 0 && m->gone[observer]) return;
    const int64_t weight = observer < 0 ? n - 1 : 1;
    metrics_sums *sum = m->sums;
    for (int k = 0; k < n; k++) {
        const int64_t woken = m->woken[k], sent = t->sent_slot[k];
        if (woken < 0 || !m->moving[k] || k == observer) continue;
        const int64_t age = last - (sent >= woken ? sent : woken - 1);
        sum->waking_count += weight;
        sum->waking_sum += weight * age;
        if (age > sum->waking_max) sum->waking_max = age;
        if (sent < woken || m->heard[k]) continue;
        m->heard[k] = 1;
        const int64_t delay = last - woken;
        m->delays[delay < METRICS_DELAYS ? delay : METRICS_DELAYS - 1]++;
    }
}

static void wakings(metrics *m, const swarm *s, int64_t last, const double *now)
{
    const int n = m->n;
    for (int table = 0; table < s->table_count; table++) table_wakings(m, &s->tables[table], last);
    for (int k = 0; k < n; k++) {
        if (m->woken[k] < 0) continue;
        const double dx = now[k] - m->goal[k], dy = now[n + k] - m->goal[n + k],
                     dz = now[2 * n + k] - m->goal[2 * n + k];
        if (sqrt(dx * dx + dy * dy + dz * dz) <= m->r_min) m->woken[k] = -1;
    }
}

int metrics_update(metrics *m, int64_t slot)
{
    const double *now = m->track + (long)(m->steps - 1) * 3 * m->n;
    int state = distances(m, slot) ? METRICS_CRASHED : 0;
    if (arrived(m, now)) state |= METRICS_ARRIVED;
    if (m->tables && slot >= m->news_from) news(m, m->tables, slot, now);
    if (m->tables) wakings(m, m->tables, slot - 1, now);
    return state;
}
