#include "avoider.h"

#include <math.h>

#include "internal.h"
#include "simd.h"

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

/* Leaves alone what exceeds v_max by rounding only: for a vector that was limited before the branch
 * would be a toss. */
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
static void prefer(const dtsa_avoid_params *params, const double position[3], const double goal[3],
                   double preferred[3])
{
    for (int axis = 0; axis < 3; axis++)
        preferred[axis] = params->gain * (goal[axis] - position[axis]);
    limit(preferred, params->v_max);
}

/* --- one agent
 * -------------------------------------------------------------------------------------------------
 */

void avoid_command(int kind, const dtsa_avoid_params *params, int n, int self,
                   const double position[3], const double velocity[3], const double goal[3],
                   const double *others_p, const double *others_v, const double *age_s,
                   double *scratch, double command[3])
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
    if (kind == DTSA_AVOID_ORCA) {
        /* a small turn to the right lets symmetric meetings resolve */
        const double x = query.preferred[0], y = query.preferred[1];
        query.preferred[0] = x + params->bias * y;
        query.preferred[1] = y - params->bias * x;
        limit(query.preferred, params->v_max);
        avoid_orca(&query, command);
    } else if (kind == DTSA_AVOID_POTENTIAL) {
        avoid_potential(&query, command);
    } else if (kind == DTSA_AVOID_BVC) {
        avoid_bvc(&query, command);
    } else {
        for (int axis = 0; axis < 3; axis++) command[axis] = query.preferred[axis];
    }
    limit(command, params->v_max);
}
