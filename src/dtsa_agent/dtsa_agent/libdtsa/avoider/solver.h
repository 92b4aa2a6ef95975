/* The point nearest to a wish under soft half-spaces, exactly:
 *     minimise |x - x0|^2 / 2 + rho / 2 * sum_j max(0, b_j - n_j.x)^2        over x in R^3
 * The function is strongly convex and piecewise quadratic: Newton's method with a line search ends
 * after a few passes, as soon as a full step leaves the set of violated half-spaces as it was. It
 * is the same problem whose dual Hildreth's sweeps climb slowly. */
#ifndef DTSA_AVOIDER_SOLVER_H
#define DTSA_AVOIDER_SOLVER_H

#include "simd.h"

enum { SOLVER_STEPS = 60, SOLVER_HALVINGS = 40 };

#ifdef SOLVER_OWN_PASSES /* by the file that includes this */
typedef struct soft_problem soft_problem;
#else
typedef struct {
    int blocks; /* whole vectors of half-spaces; padding has n = 0, b < 0 */
    const double *x, *y, *z, *b;
    double *bits; /* one value a block: which of its half-spaces were violated at the last pass */
    double rho;
    const double *wish; /* x0 */
} soft_problem;
#endif

/* Value, gradient and curvature at one point. */
typedef struct {
    double value;
    double gx, gy, gz;
    double xx, xy, xz, yy, yz, zz;
    int violated; /* some half-space is */
    int changed;  /* the set of violated ones differs from that of the previous pass */
} soft_pass;

#ifdef SOLVER_OWN_PASSES
#define SOLVER_STEP static __attribute__((noinline)) /* less stack */
static void soft_begin(const soft_problem *p, double x[3]);
static void soft_evaluate(const soft_problem *p, const double at[3], soft_pass *pass);
#else
#define SOLVER_STEP AVOID_INLINE
/* Nothing is violated so far; x is the wish. */
AVOID_INLINE void soft_begin(const soft_problem *p, double x[3])
{
    for (int k = 0; k < p->blocks; k++) ((int64_t *)p->bits)[k] = 0;
    for (int axis = 0; axis < 3; axis++) x[axis] = p->wish[axis];
}

AVOID_INLINE void soft_evaluate(const soft_problem *p, const double at[3], soft_pass *out)
{
    const v4d ax = v4_all(at[0]), ay = v4_all(at[1]), az = v4_all(at[2]), zero = v4_all(0.0);
    v4d f = zero, gx = zero, gy = zero, gz = zero;
    v4d xx = zero, xy = zero, xz = zero, yy = zero, yz = zero, zz = zero;
    int64_t *before = (int64_t *)p->bits;
    int64_t changed = 0, violated = 0;
    for (int k = 0; k < p->blocks; k++) {
        const v4d nx = v4_load(p->x + LANES * k), ny = v4_load(p->y + LANES * k),
                  nz = v4_load(p->z + LANES * k);
        const v4d lack = v4_load(p->b + LANES * k) - (nx * ax + ny * ay + nz * az);
        const v4i active = lack > zero;
        const int64_t bits = v4_bits(active);
        changed |= bits ^ before[k];
        before[k] = bits;
        if (!bits) continue;
        violated = 1;
        const v4d s = v4_keep(active, lack);
        const v4d mx = v4_keep(active, nx), my = v4_keep(active, ny), mz = v4_keep(active, nz);
        f += s * s;
        gx += s * nx;
        gy += s * ny;
        gz += s * nz;
        xx += mx * nx;
        xy += mx * ny;
        xz += mx * nz;
        yy += my * ny;
        yz += my * nz;
        zz += mz * nz;
    }
    const double dx = at[0] - p->wish[0], dy = at[1] - p->wish[1], dz = at[2] - p->wish[2];
    soft_pass pass = {.violated = (int)violated, .changed = changed != 0};
    pass.value = 0.5 * (dx * dx + dy * dy + dz * dz);
    pass.gx = dx;
    pass.gy = dy;
    pass.gz = dz;
    if (violated) {
        const double rho = p->rho;
        pass.value += 0.5 * rho * v4_sum(f);
        pass.gx -= rho * v4_sum(gx);
        pass.gy -= rho * v4_sum(gy);
        pass.gz -= rho * v4_sum(gz);
        pass.xx = 1.0 + rho * v4_sum(xx);
        pass.xy = rho * v4_sum(xy);
        pass.xz = rho * v4_sum(xz);
        pass.yy = 1.0 + rho * v4_sum(yy);
        pass.yz = rho * v4_sum(yz);
        pass.zz = 1.0 + rho * v4_sum(zz);
    } else {
        pass.xx = pass.yy = pass.zz = 1.0;
    }
    *out = pass;
}
#endif

/* step = -H^-1 g; H is symmetric and at least the identity. */
SOLVER_STEP void soft_newton(const soft_pass *h, const soft_pass *g, double step[3])
{
    const double a = h->yy * h->zz - h->yz * h->yz;
    const double b = h->xz * h->yz - h->xy * h->zz;
    const double c = h->xy * h->yz - h->xz * h->yy;
    const double d = h->xx * h->zz - h->xz * h->xz;
    const double e = h->xy * h->xz - h->xx * h->yz;
    const double f = h->xx * h->yy - h->xy * h->xy;
    const double scale = -1.0 / (h->xx * a + h->xy * b + h->xz * c);
    step[0] = scale * (a * g->gx + b * g->gy + c * g->gz);
    step[1] = scale * (b * g->gx + d * g->gy + e * g->gz);
    step[2] = scale * (c * g->gx + e * g->gy + f * g->gz);
}

/* Writes the minimiser; returns 1 if it was reached, 0 if the steps ran out (then x is the best
 * point found). */
AVOID_INLINE int soft_minimise(const soft_problem *p, double x[3])
{
    soft_pass here, there;
    soft_begin(p, x);
    soft_evaluate(p, x, &here);
    if (!here.violated) return 1;
    for (int k = 0; k < SOLVER_STEPS; k++) {
        double step[3];
        soft_newton(&here, &here, step);
        const double slope = step[0] * here.gx + step[1] * here.gy + step[2] * here.gz;
        const double noise = 1e-15 * (1.0 + here.value);
        if (-slope <= 1e-28) return 1;
        double t = 1.0;
        double to[3];
        for (int halving = 0;; halving++) {
            for (int axis = 0; axis < 3; axis++) to[axis] = x[axis] + t * step[axis];
            soft_evaluate(p, to, &there);
            if (there.value <= here.value + 1e-4 * t * slope + noise || halving == SOLVER_HALVINGS)
                break;
            t *= 0.5;
        }
        for (int axis = 0; axis < 3; axis++) x[axis] = to[axis];
        if (t == 1.0 && !there.changed) {
            /* the minimiser of this piece; once more with its own gradient removes the rounding of
             * the first step */
            soft_newton(&here, &there, step);
            for (int axis = 0; axis < 3; axis++) x[axis] += step[axis];
            return 1;
        }
        here = there;
    }
    return 0;
}

#endif
