/* Reciprocal avoidance in three dimensions, soft: one half-plane of velocities for each neighbour
 * within reach. */
#include "internal.h"
#include "root.h"

#ifndef DTSA_SOFT_DOUBLES /* orca_scalar.c has it for those */
#include "solver.h"

/* Lanes of a block's set bits, first ones first. */
static const int32_t LANE_LISTS[16][LANES] = {
    {0, 0, 0, 0}, {0, 0, 0, 0}, {1, 0, 0, 0}, {0, 1, 0, 0}, {2, 0, 0, 0}, {0, 2, 0, 0},
    {1, 2, 0, 0}, {0, 1, 2, 0}, {3, 0, 0, 0}, {0, 3, 0, 0}, {1, 3, 0, 0}, {0, 1, 3, 0},
    {2, 3, 0, 0}, {0, 2, 3, 0}, {1, 2, 3, 0}, {0, 1, 2, 3},
};
static const int8_t LANE_COUNTS[16] = {0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4};

AVOID_INLINE v4d orca_margin(const dtsa_avoid_params *params, v4d age)
{
    return v4_max(v4_min(v4_all(params->margin_rate) * age, v4_all(params->margin_max)),
                  v4_all(0.0));
}

/* Those of one block that are within reach, appended to `who`; returns their number. Without
 * branches: which agents are near is anybody's guess, and a wrong one costs more than the work. */
AVOID_INLINE int orca_append(int32_t *who, int first, int self, v4d dx, v4d dy, v4d dz, v4d reach)
{
    int bits = v4_bits(dx * dx + dy * dy + dz * dz < reach * reach);
    bits &= ~((int)((unsigned)(self - first) < LANES) << ((self - first) & (LANES - 1)));
    for (int l = 0; l < LANES; l++) who[l] = first + LANE_LISTS[bits][l];
    return LANE_COUNTS[bits];
}

/* Writes the indices of the neighbours within R_c + 2 v_max T in ascending order; returns how many.
 * Whoever's position is not a number fails the comparison. */
AVOID_INLINE int orca_neighbours(const avoid_query *q, int32_t *who)
{
    const dtsa_avoid_params *params = q->params;
    const int n = q->n, whole = n / LANES * LANES;
    const double *ox = q->others_p, *oy = ox + n, *oz = oy + n;
    const v4d px = v4_all(q->position[0]), py = v4_all(q->position[1]), pz = v4_all(q->position[2]);
    const v4d reach = v4_all(params->radius + 2.0 * params->v_max * params->horizon);
    int m = 0;
    for (int first = 0; first < whole; first += LANES) {
        const v4d far = q->age_s ? reach + orca_margin(params, v4_load(q->age_s + first)) : reach;
        m += orca_append(who + m, first, q->self, v4_load(ox + first) - px,
                         v4_load(oy + first) - py, v4_load(oz + first) - pz, far);
    }
    if (whole < n) {
        v4d x = v4_all((double)NAN), y = x, z = x, age = v4_all(0.0);
        for (int l = 0; whole + l < n; l++) {
            x[l] = ox[whole + l];
            y[l] = oy[whole + l];
            z[l] = oz[whole + l];
            age[l] = q->age_s ? q->age_s[whole + l] : 0.0;
        }
        const v4d far = q->age_s ? reach + orca_margin(params, age) : reach;
        m += orca_append(who + m, whole, q->self, x - px, y - py, z - pz, far);
    }
    return m;
}

AVOID_INLINE v4d orca_gather(const double *plane, const int32_t *who)
{
    return (v4d){plane[who[0]], plane[who[1]], plane[who[2]], plane[who[3]]};
}

/* Velocities exactly at the centre of the obstacle have no nearest way out: go straight away from
 * the neighbour. Two agents at the very same point part along x, in the order of their ids. */
AVOID_INLINE void orca_part(int self, const int32_t *who, v4i lanes, const v4d r[3], v4d *nx,
                            v4d *ny, v4d *nz)
{
    for (int l = 0; l < LANES; l++) {
        if (!lanes[l]) continue;
        const double x = r[0][l], y = r[1][l], z = r[2][l];
        const double distance = sqrt(x * x + y * y + z * z);
        const int apart = distance > 0.0;
        (*nx)[l] = apart ? -x / distance : who[l] > self ? -1.0 : 1.0;
        (*ny)[l] = apart ? -y / distance : 0.0;
        (*nz)[l] = apart ? -z / distance : 0.0;
    }
}

/* Half-planes n.v >= b of the m neighbours (planes X, Y, Z, B); returns the number of whole
 * vectors. With w = w0 - s r the three cases of RVO2-3D differ in s only: 1 / T_s when they overlap
 * already, 1 / T at the round end of the velocity obstacle, and t on its cone; kappa = R_c s - |w|.
 */
AVOID_INLINE int orca_half_planes(const avoid_query *q, int32_t *who, int m)
{
    const dtsa_avoid_params *params = q->params;
    const int n = q->n;
    const double *ox = q->others_p, *oy = ox + n, *oz = oy + n, *ux_of = q->others_v,
                 *uy_of = ux_of + n;
    const double *uz_of = uy_of + n;
    double *out_x = avoid_plane(q, PLANE_X), *out_y = avoid_plane(q, PLANE_Y),
           *out_z = avoid_plane(q, PLANE_Z);
    double *b = avoid_plane(q, PLANE_B);
    const v4d px = v4_all(q->position[0]), py = v4_all(q->position[1]), pz = v4_all(q->position[2]);
    const v4d vx = v4_all(q->velocity[0]), vy = v4_all(q->velocity[1]), vz = v4_all(q->velocity[2]);
    const v4d per_period = v4_all(1.0 / params->period),
              per_horizon = v4_all(1.0 / params->horizon);
    const v4d one = v4_all(1.0), half = v4_all(0.5), tiny = v4_all(1e-12), zero = v4_all(0.0);
    const int blocks = (m + LANES - 1) / LANES;
    for (int k = m; k < LANES * blocks; k++) /* padding: the last one again, wiped out below */
        who[k] = who[m - 1];
    for (int k = 0; k < LANES * blocks; k += LANES) {
        const int32_t *at = who + k;
        const v4d x = orca_gather(ox, at) - px, y = orca_gather(oy, at) - py,
                  z = orca_gather(oz, at) - pz;
        const v4d ux = vx - orca_gather(ux_of, at), uy = vy - orca_gather(uy_of, at),
                  uz = vz - orca_gather(uz_of, at);
        v4d rc = v4_all(params->radius);
        if (q->age_s) rc += orca_margin(params, orca_gather(q->age_s, at));
        const v4d r2 = x * x + y * y + z * z;
        const v4d outside = r2 - rc * rc;
        const v4d ru = x * ux + y * uy + z * uz;
        const v4i overlap = outside <= zero;
        /* round end: w = w0 - r / T points back and the cone's side is farther */
        const v4d ex = ux - per_horizon * x, ey = uy - per_horizon * y, ez = uz - per_horizon * z;
        const v4d er = ex * x + ey * y + ez * z;
        const v4i round_end = (er < zero) & (er * er > rc * rc * (ex * ex + ey * ey + ez * ez));
        /* cone: (r.w0)^2 - |r|^2 c = R_c^2 |r x w0|^2 / (|r|^2 - R_c^2), which cannot turn negative
         * by rounding (overlapping lanes may hold NaN here; they take another s) */
        const v4d cx = y * uz - z * uy, cy = z * ux - x * uz, cz = x * uy - y * ux;
        const v4d cross2 = cx * cx + cy * cy + cz * cz;
        const v4d t = (ru * outside + rc * v4_sqrt(cross2 * outside)) / (outside * r2);
        const v4d s = v4_select(overlap, per_period, v4_select(round_end, per_horizon, t));
        const v4d ax = ux - s * x, ay = uy - s * y, az = uz - s * z;
        const v4d length = v4_sqrt(ax * ax + ay * ay + az * az);
        const v4i defined = length > tiny;
        const v4d inverse = one / length;
        v4d nx = ax * inverse, ny = ay * inverse, nz = az * inverse;
        if (v4_bits(defined) != (1 << LANES) - 1)
            orca_part(q->self, at, ~defined, (const v4d[3]){x, y, z}, &nx, &ny, &nz);
        const v4d kappa = rc * s - length;
        const v4d bound = nx * vx + ny * vy + nz * vz + half * kappa;
        v4_store(out_x + k, nx);
        v4_store(out_y + k, ny);
        v4_store(out_z + k, nz);
        v4_store(b + k, bound);
    }
    for (int k = m; k < LANES * blocks; k++) {
        out_x[k] = out_y[k] = out_z[k] = 0.0;
        b[k] = -1.0;
    }
    return blocks;
}

AVOID_INLINE void orca_body(const avoid_query *q, double command[3])
{
    int32_t *who = (int32_t *)avoid_plane(
        q, PLANE_BITS); /* the solver uses this memory after the half-planes */
    const int m = orca_neighbours(q, who);
    const soft_problem problem = {
        .blocks = orca_half_planes(q, who, m),
        .x = avoid_plane(q, PLANE_X),
        .y = avoid_plane(q, PLANE_Y),
        .z = avoid_plane(q, PLANE_Z),
        .b = avoid_plane(q, PLANE_B),
        .bits = avoid_plane(q, PLANE_BITS),
        .rho = q->params->softness,
        .wish = q->preferred,
    };
    soft_minimise(&problem, command);
}

static void orca_baseline(const avoid_query *query, double command[3])
{
    orca_body(query, command);
}

AVOID_AVX2 static void orca_avx2(const avoid_query *query, double command[3])
{
    orca_body(query, command);
}

void avoid_orca(const avoid_query *query, double command[3])
{
    if (avoid_level_in_force > 0)
        orca_avx2(query, command);
    else
        orca_baseline(query, command);
}

#endif
