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

/* Paths flown and the smallest distance; the first two closer than `collision_m` have crashed. */
static void distances(metrics *m, int64_t slot)
{
    const int n = m->n;
    for (int step = 0; step < m->steps; step++) {
        const double *x = m->track + (long)step * 3 * n, *y = x + n, *z = y + n;
        for (int k = 0; k < n - 1; k++) {
            const double d2 =
                nearest2(n - k - 1, x + k + 1, y + k + 1, z + k + 1, x[k], y[k], z[k]);
            if (d2 < m->min_distance2) {
                m->min_distance2 = d2;
                m->pair_1 = k + 1;
                m->pair_2 = nearest_index(k + 1, n, x, y, z, k) + 1;
                m->min_slot = slot;
            }
        }
        if (m->crash_slot < 0 && m->min_distance2 < m->collision_m * m->collision_m) {
            m->crash_slot = slot;
            m->crash_1 = m->pair_1;
            m->crash_2 = m->pair_2;
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

DTSA_SIMD
static void gaps(int n, const double *restrict p, const double *restrict truth,
                 double *restrict gap)
{
    for (int k = 0; k < n; k++) {
        const double dx = p[k] - truth[k], dy = p[n + k] - truth[n + k],
                     dz = p[2 * n + k] - truth[2 * n + k];
        gap[k] = sqrt(dx * dx + dy * dy + dz * dz);
    }
}

/* Ages and errors in one table. */
static void table_news(metrics *m, const dtsa_table *t, int64_t slot, const double *truth)
{
    const int n = m->n, observer = t->observer;
    const int64_t weight = observer < 0 ? n - 1 : 1;
    const int64_t *sent = t->sent_slot;
    int64_t count = 0, sum = 0, oldest = slot;
    double *gap = t->ages, errors = 0.0, worst = m->error_max;
    gaps(n, t->est_p, truth, gap);
    for (int k = 0; k < n; k++) {
        if (!m->moving[k] || !t->in_ap[k] || k == observer || sent[k] < 0) continue;
        count++;
        sum += sent[k];
        oldest = sent[k] < oldest ? sent[k] : oldest;
        errors += gap[k];
        worst = gap[k] > worst ? gap[k] : worst;
    }
    m->age_count += weight * count;
    m->age_sum += weight * (count * (slot - 1) - sum);
    if (count && slot - 1 - oldest > m->age_max) m->age_max = slot - 1 - oldest;
    m->error_max = worst;
    m->error_sum += errors * (double)weight;
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
    if (observer >= 0 && m->lost[observer]) return;
    const int64_t weight = observer < 0 ? n - 1 : 1;
    int64_t count = 0, sum = 0, oldest = last;
    for (int k = 0; k < n; k++) {
        const int64_t woken = m->woken[k], sent = t->sent_slot[k];
        if (woken < 0 || !m->moving[k] || k == observer) continue;
        const int64_t known = sent >= woken ? sent : woken - 1;
        count++;
        sum += known;
        oldest = known < oldest ? known : oldest;
        if (sent < woken || m->heard[k] || !weight) continue; /* no weight: it is alone */
        m->heard[k] = 1;
        m->delays[m->wakings_heard++] = last - woken;
    }
    m->waking_count += weight * count;
    m->waking_sum += weight * (count * last - sum);
    if (last - oldest > m->waking_max) m->waking_max = last - oldest;
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

/* Agents that get a goal as a slot begins. One that has flown through a goal without a rest has been
 * flying all the time. */
static void wake(metrics *m, int64_t slot)
{
    const course *c = m->course;
    const int n = m->n;
    for (int k = 0; k < n; k++) {
        const int final = !c || course_is_final(c, k), rests = !c || final || c->pause[k] > 0;
        for (int i = 0; i < 3 && c; i++)
            m->goal[i * n + k] = rests ? c->goal[i * n + k] : (double)NAN;
        if (!m->flies[k] || m->woken[k] >= 0 || (c && c->changed[k] != slot)) continue;
        m->woken[k] = slot;
        m->heard[k] = 0;
        m->wakings++;
    }
}

static void follow(metrics *m, int64_t slot)
{
    if (m->course && course_advance(m->course, slot, m->last_position)) wake(m, slot);
}

void metrics_start(metrics *m)
{
    if (m->course)
        follow(m, 0);
    else
        wake(m, 0);
}

void metrics_compare(metrics *m, int64_t slot, int count, const uint32_t *digest,
                     const uint16_t *chosen)
{
    int split = 0, torn = 0;
    for (int k = 1; k < count; k++) {
        split |= digest[k] != digest[0];
        torn |= chosen[k] != chosen[0];
    }
    m->compared += count > 0;
    m->torn += torn;
    m->split += split;
    if (split && m->split_slot < 0) m->split_slot = slot;
}

/* Nobody has further goals; those that are lost do not count. */
static int all_final(const metrics *m)
{
    for (int k = 0; k < m->n && m->course; k++)
        if (!m->lost[k] && !course_is_final(m->course, k)) return 0;
    return 1;
}

int metrics_update(metrics *m, int64_t slot, int outcome)
{
    const int64_t done = slot + 1;
    const double *now = m->track + (long)(m->steps - 1) * 3 * m->n;
    for (int k = 0; k < m->n && !m->slots; k++) /* an agent that flies already has just woken */
        if (m->woken[k] >= 0 && m->woken[k] < slot) m->woken[k] = slot;
    m->slots = done;
    m->outcomes[outcome]++;
    distances(m, done);
    const int at_targets = arrived(m, now);
    if (m->tables && done >= m->news_from) news(m, m->tables, done, now);
    if (m->tables) wakings(m, m->tables, slot, now);
    follow(m, done);
    if (m->crash_slot == done && m->stop_on_crash) return m->end = METRICS_CRASHED;
    if (at_targets && !m->waits && m->completion_slot < 0 && all_final(m)) {
        m->completion_slot = done;
        m->limit = done + m->tail;
    }
    if (done >= m->limit) m->end = m->completion_slot < 0 ? METRICS_TIMED_OUT : METRICS_COMPLETED;
    return m->end;
}
