/* A smooth repulsive field with a sideways share. */
#include <math.h>

#include "internal.h"
#include "simd.h"

AVOID_INLINE void potential_body(const avoid_query *q, double command[3])
{
    const dtsa_avoid_params *params = q->params;
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
