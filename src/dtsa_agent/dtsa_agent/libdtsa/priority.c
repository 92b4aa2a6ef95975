/* The paper's priority value and selection function.
 *
 *   eta_{j,k} = |v_jk| t_s / |p_kj| * (pi - alpha_jk) / pi
 *   alpha_jk  = arccos(v_jk . p_kj / (|v_jk| |p_kj|))
 *   g_k       = sum over j != k of eta_{j,k}                     (eq:permission_d_p_ang)
 *
 * eta is symmetric in j and k, so each pair is computed once. (pi - arccos x) / pi = 1/2 +
 * arcsin(x) / pi, and arcsin is our own polynomial: libm's last bit differs between machines, and
 * agents must agree on every bit.
 */
#include <math.h>

#include "core.h"
#include "root.h"

static const double INV_PI = 0.31830988618379067154;

int priority_scratch_doubles(int n) { return 7 * n; }

/* arcsin(sqrt z) / sqrt z on [0, 1/4], minimax to 2e-17 relative. */
static inline double arcsin_series(double z)
{
    double r = 0.03187962140081284;
    r = r * z + -0.016187392271599134;
    r = r * z + 0.019513468251252167;
    r = r * z + 0.0065293020047365695;
    r = r * z + 0.012170138592391726;
    r = r * z + 0.01388484282640208;
    r = r * z + 0.01735977964134998;
    r = r * z + 0.022371749733164054;
    r = r * z + 0.03038195969768514;
    r = r * z + 0.044642856805998936;
    r = r * z + 0.07500000000385201;
    r = r * z + 0.16666666666664942;
    return r * z + 1.0;
}

/* eta of agent k with agents k+1 .. n-1, elementwise: the same bits at any vector width. */
DTSA_SIMD
static void eta_row(int count, double slot_s, const double *restrict px, const double *restrict py,
                    const double *restrict pz, const double *restrict vx, const double *restrict vy,
                    const double *restrict vz, double kpx, double kpy, double kpz, double kvx,
                    double kvy, double kvz, double *restrict eta)
{
    for (int j = 0; j < count; j++) {
        const double dx = kpx - px[j], dy = kpy - py[j], dz = kpz - pz[j];
        const double wx = vx[j] - kvx, wy = vy[j] - kvy, wz = vz[j] - kvz;
        const double d2 = dx * dx + dy * dy + dz * dz;
        const double w2 = wx * wx + wy * wy + wz * wz;
#ifdef DTSA_SOFT_DOUBLES
        if (w2 == 0.0) { /* as below, with less work */
            eta[j] = 0.0;
            continue;
        }
#endif
        const double product = root(d2 * w2);
        const int none =
            !(product > 0.0); /* v_jk = 0: eta = 0; p_kj = 0: crashed, the run is over */
        const double inverse = 1.0 / (none ? 1.0 : product);
        double x = (wx * dx + wy * dy + wz * dz) * inverse;
        x = x > 1.0 ? 1.0 : x;
        x = x < -1.0 ? -1.0 : x;
        const double a = fabs(x);
        const int steep = a > 0.5;
        const double half = 0.5 * (1.0 - a);
        const double z = steep ? half : a * a;
        const double s = steep ? root(half) : a;
        const double r = s * arcsin_series(z);
        const double asin_a = steep ? 1.5707963267948966 - 2.0 * r : r;
        const double share = 0.5 + copysign(asin_a, x) * INV_PI;
        const double e = w2 * inverse * slot_s * share;
        eta[j] = none ? 0.0 : e;
    }
}

DTSA_SIMD
static void add_row(int count, const double *restrict eta, double *restrict g)
{
    for (int j = 0; j < count; j++) g[j] += eta[j];
}

static double sum_row(int count, const double *eta)
{
    double s0 = 0.0, s1 = 0.0, s2 = 0.0, s3 = 0.0;
    int j = 0;
    for (; j + 4 <= count; j += 4) {
        s0 += eta[j];
        s1 += eta[j + 1];
        s2 += eta[j + 2];
        s3 += eta[j + 3];
    }
    for (; j < count; j++) s0 += eta[j];
    return (s0 + s1) + (s2 + s3);
}

void priority_values(int n, double slot_s, const double *p, const double *v, double *g,
                     double *scratch)
{
    double *eta = scratch;
    const double *px = p, *py = p + n, *pz = p + 2 * n, *vx = v, *vy = v + n, *vz = v + 2 * n;
    for (int k = 0; k < n; k++) g[k] = 0.0;
    for (int k = 0; k < n - 1; k++) {
        const int from = k + 1, count = n - from;
        eta_row(count, slot_s, px + from, py + from, pz + from, vx + from, vy + from, vz + from,
                px[k], py[k], pz[k], vx[k], vy[k], vz[k], eta);
        add_row(count, eta, g + from);
        g[k] += sum_row(count, eta);
    }
    for (int k = 0; k < n; k++)
        if (vx[k] == 0.0 && vy[k] == 0.0 && vz[k] == 0.0) g[k] = 0.0;
}

double priority_of(int n, double slot_s, const double *p, const double *v, int k, double *eta)
{
    const double *px = p, *py = p + n, *pz = p + 2 * n, *vx = v, *vy = v + n, *vz = v + 2 * n;
    if (vx[k] == 0.0 && vy[k] == 0.0 && vz[k] == 0.0) return 0.0;
    /* As j sees k or k sees j: both signs change, and the bits are the same. k with itself: 0. */
    eta_row(n, slot_s, px, py, pz, vx, vy, vz, px[k], py[k], pz[k], vx[k], vy[k], vz[k], eta);
    double g = 0.0;
    for (int j = 0; j < k; j++) g += eta[j];
    return g + sum_row(n - k - 1, eta + k + 1);
}

/* The largest counter h among the agents of `set`, the lowest id on ties; -1 if the set is empty.
 */
static int oldest(int n, const int64_t *h, const uint8_t *set)
{
    int best = -1;
    for (int k = 0; k < n; k++)
        if (set[k] && (best < 0 || h[k] > h[best])) best = k;
    return best;
}

/* The selection function read literally: one scan that keeps the significantly greater of two. */
static int select_pairwise(int n, double epsilon, const double *g, const int64_t *h,
                           const uint8_t *in_ap, int *reason)
{
    int best = -1;
    *reason = DTSA_REASON_PRIORITY;
    for (int k = 0; k < n; k++) {
        if (!in_ap[k]) continue;
        if (best < 0) {
            best = k;
            continue;
        }
        const double top = g[k] > g[best] ? g[k] : g[best];
        const double gap = g[k] > g[best] ? g[k] - g[best] : g[best] - g[k];
        if (top > 0.0 && gap / top > epsilon) { /* eq:pfs: significantly different */
            if (g[k] > g[best]) best = k, *reason = DTSA_REASON_PRIORITY;
        } else {
            *reason = DTSA_REASON_TIE;
            if (h[k] > h[best]) best = k;
        }
    }
    return best;
}

int select_sender(int n, int selection, double epsilon, const double *g, const int64_t *h,
                  const uint8_t *in_ap, uint8_t *candidates, int *reason)
{
    double top = 0.0;
    int any = 0;
    for (int k = 0; k < n; k++) {
        if (candidates) candidates[k] = 0;
        if (!in_ap[k]) continue;
        any = 1;
        if (g[k] > top) top = g[k];
    }
    *reason = DTSA_REASON_NOBODY;
    if (!any) return -1;
    if (top <= 0.0) {
        *reason = DTSA_REASON_OLDEST;
        return oldest(n, h, in_ap);
    }
    if (selection == DTSA_SELECT_PAIRWISE) return select_pairwise(n, epsilon, g, h, in_ap, reason);
    const double floor_g = (1.0 - epsilon) * top;
    int best = -1, count = 0;
    for (int k = 0; k < n; k++) {
        if (!in_ap[k] || g[k] < floor_g) continue;
        count++;
        if (candidates) candidates[k] = 1;
        if (best < 0 || h[k] > h[best]) best = k;
    }
    *reason = count > 1 ? DTSA_REASON_TIE : DTSA_REASON_PRIORITY;
    return best;
}
