#include "avoider.h"

#include <math.h>

#include "avoider_internal.h"
#include "avoider_simd.h"

int avoid_level_in_force = -1; /* -1: not yet decided */

int avoid_vector_level(int level)
{
    int best = 0;
    if (level < 0 && avoid_level_in_force >= 0) return avoid_level_in_force;
#if AVOID_HAVE_AVX2
    __builtin_cpu_init();
    best = __builtin_cpu_supports("avx2") ? 1 : 0;
#endif
    avoid_level_in_force = level >= 0 && level < best ? level : best;
    return avoid_level_in_force;
}

int avoid_scratch_doubles(int n) { return PLANES * avoid_plane_length(n); }

/* Leaves alone what exceeds v_max by rounding only: for a vector that was limited before the branch would be a toss. */
static inline void limit(double v[3], double v_max)
{
    double squared = v[0] * v[0] + v[1] * v[1] + v[2] * v[2];
    if (squared > v_max * v_max * (1.0 + 1e-12)) {
        double scale = v_max / sqrt(squared);
        v[0] *= scale;
        v[1] *= scale;
        v[2] *= scale;
    }
}

/* v_pref = min(v_max, K_P d) towards the goal. */
static void prefer(const avoid_params *params, const double position[3], const double goal[3],
                   double preferred[3])
{
    for (int axis = 0; axis < 3; axis++)
        preferred[axis] = params->gain * (goal[axis] - position[axis]);
    limit(preferred, params->v_max);
}

/* --- potential: a smooth repulsive field with a sideways share ------------------------------------------------ */

AVOID_INLINE void potential_body(const avoid_query *q, double command[3])
{
    const avoid_params *params = q->params;
    const v4d px = v4_all(q->position[0]), py = v4_all(q->position[1]), pz = v4_all(q->position[2]);
    const v4d strength = v4_all(params->strength), least = v4_all(0.02),
              most = v4_all(4.0 * params->v_max);
    const v4d tiny = v4_all(1e-12), one = v4_all(1.0);
    v4d sum_x = v4_all(0.0), sum_y = sum_x, sum_z = sum_x;

    for (int first = 0; first < q->n; first += LANES) {
        double x[LANES], y[LANES], z[LANES], margin[LANES];
        const int count = q->n - first < LANES ? q->n - first : LANES;
        for (int l = 0; l < LANES; l++) {
            const int j = first + l;
            const int real = l < count && j != q->self;
            x[l] = real ? q->others_p[j] : (double)NAN;
            y[l] = real ? q->others_p[q->n + j] : 0.0;
            z[l] = real ? q->others_p[2 * q->n + j] : 0.0;
            margin[l] = real && q->age_s ? avoid_margin(params, q->age_s[j]) : 0.0;
        }
        const v4d dx = px - v4_load(x), dy = py - v4_load(y), dz = pz - v4_load(z);
        const v4d reach = v4_all(params->influence) + v4_load(margin);
        const v4d core = v4_all(params->core) + v4_load(margin);
        const v4d squared = dx * dx + dy * dy + dz * dz;
        const v4i near = squared < reach * reach;
        if (!v4_bits(near)) continue;
        const v4d distance = v4_sqrt(squared);
        const v4d inverse = one / v4_max(distance, tiny);
        const v4d f =
            v4_min(strength * (one / v4_max(distance - core, least) - one / (reach - core)), most);
        const v4d scaled = v4_keep(near, f * inverse);
        const v4d side = scaled * v4_all(params->tangential);
        /* f (e + 0.3 z x e), z x e = (-e_y, e_x, 0) */
        sum_x += v4_keep(near, scaled * dx - side * dy);
        sum_y += v4_keep(near, scaled * dy + side * dx);
        sum_z += v4_keep(near, scaled * dz);
    }
    command[0] = q->preferred[0] + v4_sum(sum_x);
    command[1] = q->preferred[1] + v4_sum(sum_y);
    command[2] = q->preferred[2] + v4_sum(sum_z);
}

static void potential_baseline(const avoid_query *query, double command[3])
{
    potential_body(query, command);
}

AVOID_AVX2 static void potential_avx2(const avoid_query *query, double command[3])
{
    potential_body(query, command);
}

void avoid_potential(const avoid_query *query, double command[3])
{
    if (avoid_level_in_force > 0)
        potential_avx2(query, command);
    else
        potential_baseline(query, command);
}

/* --- one agent ------------------------------------------------------------------------------------------------- */

void avoid_command(int kind, const avoid_params *params, int n, int self, const double position[3],
                   const double velocity[3], const double goal[3], const double *others_p,
                   const double *others_v, const double *age_s, double *scratch, double command[3])
{
    avoid_query query = {
        .params = params,
        .n = n,
        .self = self,
        .position = position,
        .velocity = velocity,
        .goal = goal,
        .others_p = others_p,
        .others_v = others_v,
        .age_s = params->margin_rate > 0.0 ? age_s : NULL,
        .scratch = scratch,
    };
    if (avoid_level_in_force < 0) avoid_vector_level(-1);
    prefer(params, position, goal, query.preferred);
    if (kind == AVOID_ORCA) {
        /* a small turn to the right lets symmetric meetings resolve */
        const double x = query.preferred[0], y = query.preferred[1];
        query.preferred[0] = x + params->bias * y;
        query.preferred[1] = y - params->bias * x;
        limit(query.preferred, params->v_max);
        avoid_orca(&query, command);
    } else if (kind == AVOID_POTENTIAL) {
        avoid_potential(&query, command);
    } else if (kind == AVOID_BVC) {
        avoid_bvc(&query, command);
    } else {
        for (int axis = 0; axis < 3; axis++) command[axis] = query.preferred[axis];
    }
    limit(command, params->v_max);
}
