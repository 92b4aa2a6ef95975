/* orca.c for processors whose doubles are software: the same bits with as few operations on doubles
 * as can be.
 *
 * A neighbour counts where a point that the solver looks at violates its half-plane. Single
 * precision, which such processors have, says of most that they do not: the half-plane of a
 * neighbour is computed when that is not certain. What is left out adds zeros to sums in orca.c;
 * the order of the sums, in four lanes, is the same.
 *
 * Bound. The half-plane is n.x >= n.v + kappa / 2, and -kappa is the distance of u from the
 * velocity obstacle, which is at least `away`; so no point nearer to v than away / 2 violates it.
 * `away` is the distance from the infinite cone, or from the plane in front of its round end. */
#include "root.h"

#ifdef DTSA_SOFT_DOUBLES
#define SOLVER_OWN_PASSES

#include "internal.h"
#include "solver.h"

typedef struct neighbour {
    float away; /* m/s */
    uint16_t k;
    uint8_t known, active; /* its half-plane is; it was violated at the last point */
} neighbour;

struct soft_problem {
    const avoid_query *q;
    neighbour *near;
    int count;
};

static double dot(const double a[3], const double b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static float dot_near(const float a[3], const float b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static double pair_radius(const avoid_query *q, int k)
{
    return q->age_s ? q->params->radius + avoid_margin(q->params, q->age_s[k]) : q->params->radius;
}

static void relative(const avoid_query *q, int k, double r[3], double u[3])
{
    for (int i = 0; i < 3; i++) {
        r[i] = q->others_p[i * q->n + k] - q->position[i];
        u[i] = q->velocity[i] - q->others_v[i * q->n + k];
    }
}

/* From below. */
static float distance_from_obstacle(const avoid_query *q, int k, const double exact_r[3],
                                    const double exact_u[3])
{
    float r[3], u[3];
    for (int i = 0; i < 3; i++) {
        r[i] = (float)exact_r[i];
        u[i] = (float)exact_u[i];
    }
    const float rc = (float)pair_radius(q, k), per_horizon = 1.0f / (float)q->params->horizon;
    const float r2 = dot_near(r, r), outside = r2 - rc * rc, ru = dot_near(r, u);
    if (!(outside > 0.02f * r2)) return -INFINITY; /* nearly touching: not worth a bound */
    const float c[3] = {r[1] * u[2] - r[2] * u[1], r[2] * u[0] - r[0] * u[2],
                        r[0] * u[1] - r[1] * u[0]};
    const float cone = (sqrtf(dot_near(c, c) * outside) - ru * rc) / r2;
    const float length = sqrtf(r2), front = (length - rc) * per_horizon - ru / length;
    const float slack = 1e-4f * (1.0f + sqrtf(dot_near(u, u)) + length * per_horizon);
    return (cone > front ? cone : front) - slack;
}

SOLVER_STEP int find_neighbours(const avoid_query *q, neighbour *near)
{
    const dtsa_avoid_params *params = q->params;
    const double reach = params->radius + 2.0 * params->v_max * params->horizon;
    int count = 0;
    for (int k = 0; k < q->n; k++) {
        double r[3], u[3], far = reach;
        if (k == q->self) continue;
        relative(q, k, r, u);
        if (q->age_s) far += avoid_margin(params, q->age_s[k]);
        if (!(dot(r, r) < far * far)) continue;
        near[count++] = (neighbour){distance_from_obstacle(q, k, r, u), (uint16_t)k, 0, 0};
    }
    return count;
}

/* s, see orca_half_planes. */
static double scale_of(const avoid_query *q, const double r[3], const double u[3], double rc)
{
    const double r2 = dot(r, r), outside = r2 - rc * rc, per_horizon = 1.0 / q->params->horizon;
    double e[3];
    if (outside <= 0.0) return 1.0 / q->params->period;
    for (int i = 0; i < 3; i++) e[i] = u[i] - per_horizon * r[i];
    const double er = dot(e, r);
    if (er < 0.0 && er * er > rc * rc * dot(e, e)) return per_horizon;
    const double c[3] = {r[1] * u[2] - r[2] * u[1], r[2] * u[0] - r[0] * u[2],
                         r[0] * u[1] - r[1] * u[0]};
    return (dot(r, u) * outside + rc * root(dot(c, c) * outside)) / (outside * r2);
}

static void half_plane(const avoid_query *q, int k, double *plane)
{
    const double rc = pair_radius(q, k);
    double r[3], a[3], n[3];
    relative(q, k, r, a);
    const double s = scale_of(q, r, a, rc);
    for (int i = 0; i < 3; i++) a[i] = a[i] - s * r[i];
    const double length = root(dot(a, a));
    if (length > 1e-12) {
        const double inverse = 1.0 / length;
        for (int i = 0; i < 3; i++) n[i] = a[i] * inverse;
    } else { /* see orca_part */
        const double distance = root(dot(r, r));
        for (int i = 0; i < 3; i++) n[i] = distance > 0.0 ? -r[i] / distance : 0.0;
        if (!(distance > 0.0)) n[0] = k > q->self ? -1.0 : 1.0;
    }
    const long next = avoid_plane_length(q->n);
    for (int i = 0; i < 3; i++) plane[i * next] = n[i];
    plane[3 * next] = dot(n, q->velocity) + 0.5 * (rc * s - length);
}

/* Fills normal and lack of a half-plane; 0: it is not violated. */
static int violates(const soft_problem *p, int i, const double at[3], const float near_at[3],
                    double n[3], double *lack)
{
    const long next = avoid_plane_length(p->q->n);
    double *plane = avoid_plane(p->q, PLANE_X) + i;
    if (!p->near[i].known) half_plane(p->q, p->near[i].k, plane);
    p->near[i].known = 1;
    float guess = (float)plane[3 * next], size = fabsf(guess);
    for (int axis = 0; axis < 3; axis++) {
        guess -= (float)plane[axis * next] * near_at[axis];
        size += fabsf(near_at[axis]);
    }
    if (guess < -0x1p-20f * size) return 0;
    for (int axis = 0; axis < 3; axis++) n[axis] = plane[axis * next];
    *lack = plane[3 * next] - dot(n, at);
    return *lack > 0.0;
}

enum { VALUE, GX, GY, GZ, XX, XY, XZ, YY, YZ, ZZ, SUMS };

/* Sums of a lane. They are at the end of its plane: of n + 10 places n - 1 are taken. */
static double *lane_sums(const avoid_query *q, int lane) { return avoid_plane(q, lane + 1) - SUMS; }

static void add(double *sum, const double n[3], double s)
{
    sum[VALUE] += s * s;
    for (int i = 0, at = XX; i < 3; i++) {
        sum[GX + i] += s * n[i];
        for (int j = i; j < 3; j++) sum[at++] += n[i] * n[j];
    }
}

static void soft_begin(const soft_problem *p, double x[3])
{
    for (int axis = 0; axis < 3; axis++) x[axis] = p->q->preferred[axis];
}

static void soft_evaluate(const soft_problem *p, const double at[3], soft_pass *pass)
{
    double n[3], d[3], s;
    float near_at[3], way[3];
    int violated = 0, changed = 0;
    for (int i = 0; i < 3; i++) {
        near_at[i] = (float)at[i];
        way[i] = (float)(at[i] - p->q->velocity[i]);
        d[i] = at[i] - p->q->preferred[i];
    }
    const float reach = 2.0001f * sqrtf(dot_near(way, way));
    for (int i = 0; i < p->count; i++) {
        neighbour *who = &p->near[i];
        const int active = !(who->away > reach) && violates(p, i, at, near_at, n, &s);
        changed |= active != who->active;
        who->active = (uint8_t)active;
        if (!active) continue;
        for (int l = 0; l < LANES && !violated; l++)
            memset(lane_sums(p->q, l), 0, SUMS * sizeof(double));
        violated = 1;
        add(lane_sums(p->q, i % LANES), n, s);
    }
    *pass = (soft_pass){.value = 0.5 * dot(d, d),
                        .gx = d[0],
                        .gy = d[1],
                        .gz = d[2],
                        .xx = 1.0,
                        .yy = 1.0,
                        .zz = 1.0,
                        .violated = violated,
                        .changed = changed};
    if (!violated) return;
    const double rho = p->q->params->softness;
    double *sum = lane_sums(p->q, 0);
    const double *one = lane_sums(p->q, 1), *two = lane_sums(p->q, 2), *three = lane_sums(p->q, 3);
    for (int i = 0; i < SUMS; i++) sum[i] = (sum[i] + two[i]) + (one[i] + three[i]);
    pass->value += 0.5 * rho * sum[VALUE];
    for (int i = 0; i < 3; i++) (&pass->gx)[i] -= rho * sum[GX + i];
    for (int i = 0; i < 6; i++) (&pass->xx)[i] += rho * sum[XX + i];
}

void avoid_orca(const avoid_query *query, double command[3])
{
    neighbour *near = (neighbour *)avoid_plane(query, PLANE_BITS);
    const soft_problem problem = {query, near, find_neighbours(query, near)};
    soft_minimise(&problem, command);
}

#endif
