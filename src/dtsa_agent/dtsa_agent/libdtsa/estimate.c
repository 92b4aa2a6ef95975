/* Where the others are by now (eq:estimate). */
#include <string.h>

#include "core.h"

DTSA_SIMD
static void extrapolate(int n, const double *restrict p, const double *restrict v,
                        const double *restrict age, double *restrict out)
{
    for (int k = 0; k < n; k++) out[k] = p[k] + v[k] * age[k];
}

/* Towards the commanded velocity, as an unsaturated vehicle flies. */
static void estimate_intent(const dtsa_table *t, int64_t slot, int step, double *p, double *v)
{
    const dtsa_config *c = t->config;
    const int n = c->agents;
    for (int k = 0; k < n; k++) {
        const int64_t ago = t->sent_slot[k] < 0 ? 0 : (slot - t->sent_slot[k]) * c->steps + step;
        /* A frame of the next slot may be heard before this one is over: nothing has decayed then.
         */
        const int64_t decayed = ago > 0 ? ago : 0;
        const int at = decayed < c->decay_len ? (int)decayed : c->decay_len - 1;
        const double q = c->decay[at], w = c->decay[c->decay_len + at];
        for (int i = 0; i < 3; i++) {
            const int e = i * n + k;
            const double command = t->sent_c[e], d = t->sent_v[e] - command;
            p[e] = t->sent_p[e] + command * t->ages[k] + d * w;
            v[e] = command + d * q;
        }
    }
}

void estimate_into(const dtsa_table *t, int kind, int64_t slot, int step, double *p, double *v)
{
    const int n = t->config->agents;
    const size_t planes = sizeof(double) * 3 * (size_t)n;
    const double offset = step * (t->config->slot_s / t->config->steps);
    for (int k = 0; k < n; k++)
        t->ages[k] = t->sent_slot[k] < 0
                         ? 0.0
                         : (double)(slot - t->sent_slot[k]) * t->config->slot_s + offset;
    if (kind == DTSA_ESTIMATE_INTENT) {
        estimate_intent(t, slot, step, p, v);
        return;
    }
    /* hold: position and velocity as last heard. The frame carries the velocity, so the avoider may
     * use it. */
    if (kind == DTSA_ESTIMATE_HOLD)
        memcpy(p, t->sent_p, planes);
    else
        for (int i = 0; i < 3; i++)
            extrapolate(n, t->sent_p + i * n, t->sent_v + i * n, t->ages, p + i * n);
    memcpy(v, t->sent_v, planes);
}

void table_estimate(dtsa_table *t, int64_t slot, int step)
{
    const int kind = t->config->estimator;
    if (kind < DTSA_ESTIMATE_ORACLE) estimate_into(t, kind, slot, step, t->est_p, t->est_v);
}

void dtsa_decay(double tau, double dt, int length, double *table)
{
    const double q = dt < tau ? 1.0 - dt / tau : 0.0;
    double power = 1.0, way = 0.0;
    for (int k = 0; k < length; k++) {
        table[k] = power;
        table[length + k] = way;
        power *= q;
        way += dt * power;
    }
}
