/* Who sends by priority, without most of the priorities.
 *
 * The choice depends on who is within epsilon of the greatest g, hardly ever on the last bits of
 * anybody's. So g is first computed in single precision (which microcontrollers have, and of which
 * other processors do twice as many at a time), with bounds that surely contain the double. Exact
 * values are computed for the chosen one, and for those whom the bounds do not separate; the choice
 * is the same in any case.
 *
 * Bounds. Let u = 2^-23, P and V the largest coordinates, d the smallest distance. Rounded input
 * moves p_kj by a share of less than rho = 4 u P / d, and v_jk by less than 4 u V: eta changes by
 * less than (1 + 2 / pi) rho |v| / |p| + 6 u V / d (in units of t_s). Rounded operations move the
 * cosine x by less than delta = 2^-20: arccos x by less than 3 delta / max(sqrt(1 - |x|), sqrt
 * delta), because its slope is less than 1 / sqrt(1 - |x|), and no two arguments that are delta
 * apart have arccosines more than 1.001 sqrt(2 delta) apart. Lengths, series and sums of n terms:
 * less than (n + 40) u |v| / |p|. What is left over pays for terms of second order. */
#include <float.h>
#include <math.h>

#include "core.h"

enum { WIDE = 8 };

/* Parts of the scratch memory, n floats each. LOW and HIGH: bounds of g; before that g, and the sum
 * of |v| / |p|. */
enum { PX, PY, PZ, VX, VY, VZ, ETA, SIZE, SLACK, LOW, HIGH, SLACKS, NEAREST };

typedef struct rows {
    int n;
    float *at; /* of ETA .. SLACK: one row */
} rows;

static float *row(const rows *r, int which) { return r->at + (long)which * r->n; }

/* Elementwise, as eta_row. The series: arccos a / (pi sqrt(1 - a)) on [0, 1], to 1e-8 (Abramowitz
 * and Stegun, 4.4.46). */
DTSA_SIMD
static void guess_row(int count, const float *restrict px, const float *restrict py,
                      const float *restrict pz, const float *restrict vx, const float *restrict vy,
                      const float *restrict vz, float kpx, float kpy, float kpz, float kvx,
                      float kvy, float kvz, float *restrict eta, float *restrict size,
                      float *restrict slack, float *restrict nearest)
{
    for (int j = 0; j < count; j++) {
        const float dx = kpx - px[j], dy = kpy - py[j], dz = kpz - pz[j];
        const float wx = vx[j] - kvx, wy = vy[j] - kvy, wz = vz[j] - kvz;
        const float d2 = dx * dx + dy * dy + dz * dz;
        const float w2 = wx * wx + wy * wy + wz * wz;
        const float product = d2 * w2;
        const int none = !(product > FLT_MIN);
        const float inverse = 1.0f / sqrtf(none ? 1.0f : product);
        const float x = (wx * dx + wy * dy + wz * dz) * inverse;
        const float b = fabsf(x), a = b < 1.0f ? b : 1.0f;
        float series = -0.00040186338f * a + 0.0021231556f;
        series = series * a + -0.0054393193f;
        series = series * a + 0.0098331913f;
        series = series * a + -0.015970977f;
        series = series * a + 0.028322891f;
        series = series * a + -0.068308920f;
        series = series * a + 0.49999998f;
        const float root = sqrtf(1.0f - a), back = root * series;
        const float m = none ? 0.0f : w2 * inverse;
        eta[j] = m * (x > 0.0f ? 1.0f - back : back);
        size[j] = m;
        slack[j] = m * (0x1p-20f / (root > 0x1p-10f ? root : 0x1p-10f));
        nearest[j] = d2 < nearest[j] ? d2 : nearest[j];
    }
}

DTSA_SIMD
static void add_floats(int count, const float *restrict x, float *restrict to)
{
    for (int j = 0; j < count; j++) to[j] += x[j];
}

DTSA_SIMD
static float sum_floats(int count, const float *x)
{
    float lanes[WIDE] = {0.0f}, sum = 0.0f;
    int j = 0;
    for (; j + WIDE <= count; j += WIDE)
        for (int l = 0; l < WIDE; l++) lanes[l] += x[j + l];
    for (; j < count; j++) sum += x[j];
    for (int l = 0; l < WIDE; l++) sum += lanes[l];
    return sum;
}

/* -> the largest absolute value, infinite if one is no number. */
static float to_floats(int count, const double *from, float *to)
{
    float most = 0.0f;
    for (int i = 0; i < count; i++) {
        to[i] = (float)from[i];
        const float size = fabsf(to[i]);
        if (!(size <= most)) most = size <= FLT_MAX ? size : INFINITY;
    }
    return most;
}

static int at_rest(int n, const double *v, int k)
{
    return v[k] == 0.0 && v[n + k] == 0.0 && v[2 * n + k] == 0.0;
}

static void guess_all(const rows *r)
{
    const int n = r->n;
    const float *p = row(r, PX), *v = row(r, VX);
    for (int k = 0; k < n; k++) {
        row(r, LOW)[k] = row(r, HIGH)[k] = row(r, SLACKS)[k] = 0.0f;
        row(r, NEAREST)[k] = INFINITY;
    }
    for (int k = 0; k < n - 1; k++) {
        const int j = k + 1, count = n - j;
        guess_row(count, p + j, p + n + j, p + 2 * n + j, v + j, v + n + j, v + 2 * n + j, p[k],
                  p[n + k], p[2 * n + k], v[k], v[n + k], v[2 * n + k], row(r, ETA), row(r, SIZE),
                  row(r, SLACK), row(r, NEAREST) + j);
        for (int i = 0; i < 3; i++) { /* ETA to LOW, SIZE to HIGH, SLACK to SLACKS */
            add_floats(count, row(r, ETA + i), row(r, LOW + i) + j);
            row(r, LOW + i)[k] += sum_floats(count, row(r, ETA + i));
        }
    }
}

/* Fills the bounds of g / t_s; 0: there are none that are good for anything. */
static int bound(const rows *r, const double *p, const double *v)
{
    const int n = r->n;
    const float u = 0x1p-23f;
    const float far = to_floats(3 * n, p, row(r, PX)), fast = to_floats(3 * n, v, row(r, VX));
    float nearest = INFINITY;
    if (!(far <= 1e6f && fast <= 1e4f && fast >= 1e-6f)) return 0;
    guess_all(r);
    for (int k = 0; k < n; k++)
        nearest = row(r, NEAREST)[k] < nearest ? row(r, NEAREST)[k] : nearest;
    const float d = sqrtf(nearest), rho = 4.0f * u * far / d;
    if (!(d >= 1e-3f && rho <= 0.01f)) return 0;
    const float share = 4.0f * rho + (float)(n + 40) * u, fixed = 6.0f * u * fast / d * (float)n;
    for (int k = 0; k < n; k++) {
        const float g = row(r, LOW)[k], off = share * row(r, HIGH)[k] + row(r, SLACKS)[k] + fixed;
        const int rests = at_rest(n, v, k); /* then g = 0 */
        row(r, LOW)[k] = rests ? 0.0f : g - off;
        row(r, HIGH)[k] = rests ? 0.0f : g + off;
    }
    return 1;
}

/* What the bounds say: nobody's top is below `top`, and who is below `out` is no candidate, from
 * `in` on surely one. */
typedef struct limits {
    float top, out, in;
} limits;

/* 0: the bounds do not even say that the greatest g is positive. */
static int limit(const dtsa_config *c, const rows *r, const uint8_t *in_ap, limits *l)
{
    const float share = (float)(1.0 - c->epsilon);
    float top = 0.0f, most = 0.0f;
    for (int k = 0; k < c->agents; k++) {
        if (!in_ap[k]) continue;
        top = row(r, LOW)[k] > top ? row(r, LOW)[k] : top;
        most = row(r, HIGH)[k] > most ? row(r, HIGH)[k] : most;
    }
    *l = (limits){top, share * top * (1.0f - 0x1p-20f), share * most * (1.0f + 0x1p-20f)};
    return top > 0.0f;
}

/* The oldest of all who are or may be candidates; counts both. */
static int oldest_near(int n, const rows *r, const limits *l, const int64_t *h,
                       const uint8_t *in_ap, int *sure, int *maybe)
{
    int best = -1;
    *sure = *maybe = 0;
    for (int k = 0; k < n; k++) {
        if (!in_ap[k] || row(r, HIGH)[k] < l->out) continue;
        ++*(row(r, LOW)[k] >= l->in ? sure : maybe);
        if (best < 0 || h[k] > h[best]) best = k;
    }
    return best;
}

/* Exact values of those that may or may not be candidates, and of those that may be the greatest;
 * -1: they are many. */
static int settle(const dtsa_config *c, const rows *r, const limits *l, const double *p,
                  const double *v, const int64_t *h, const uint8_t *in_ap, double *g, double *eta,
                  int *reason)
{
    const int n = c->agents;
    int best = -1, count = 0, exact = 0;
    double top = 0.0;
    for (int k = 0; k < n; k++) {
        const int contends = row(r, HIGH)[k] >= l->top;
        if (!in_ap[k] || row(r, HIGH)[k] < l->out || (!contends && row(r, LOW)[k] >= l->in))
            continue;
        if (++exact > n / 3 + 1) return -1;
        g[k] = priority_of(n, c->slot_s, p, v, k, eta);
        top = g[k] > top ? g[k] : top;
    }
    const double least = (1.0 - c->epsilon) * top;
    for (int k = 0; k < n; k++) {
        if (!in_ap[k] || row(r, HIGH)[k] < l->out || g[k] < least) continue; /* NaN: surely one */
        count++;
        if (best < 0 || h[k] > h[best]) best = k;
    }
    *reason = count > 1 ? DTSA_REASON_TIE : DTSA_REASON_PRIORITY;
    return best;
}

static int select_near(const dtsa_config *c, const rows *r, const double *p, const double *v,
                       const int64_t *h, const uint8_t *in_ap, double *g, double *eta, int *reason)
{
    const int n = c->agents;
    limits l;
    int sure, maybe;
    if (!limit(c, r, in_ap, &l)) return -1;
    int best = oldest_near(n, r, &l, h, in_ap, &sure, &maybe);
    for (int k = 0; k < n; k++) g[k] = (double)NAN;
    *reason = sure > 1 ? DTSA_REASON_TIE : DTSA_REASON_PRIORITY;
    if (row(r, LOW)[best] < l.in || (sure == 1 && maybe))
        best = settle(c, r, &l, p, v, h, in_ap, g, eta, reason);
    if (best >= 0 && isnan(g[best])) g[best] = priority_of(n, c->slot_s, p, v, best, eta);
    return best;
}

int select_urgent(const dtsa_config *c, const double *p, const double *v, const int64_t *h,
                  const uint8_t *in_ap, double *g, double *scratch, int *reason)
{
    const int n = c->agents;
    const rows r = {n, (float *)scratch};
    if (c->selection == DTSA_SELECT_CANDIDATES && c->epsilon <= 1.0 && bound(&r, p, v)) {
        /* the row of floats is not needed any more */
        const int best = select_near(c, &r, p, v, h, in_ap, g, (double *)row(&r, ETA), reason);
        if (best >= 0) return best;
    }
    priority_values(n, c->slot_s, p, v, g, scratch);
    return select_sender(n, c->selection, c->epsilon, g, h, in_ap, NULL, reason);
}
