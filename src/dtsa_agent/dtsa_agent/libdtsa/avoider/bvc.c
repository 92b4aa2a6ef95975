/* Buffered Voronoi cells: fly to the point of the own cell that is nearest to the goal. The rules
 * are those of the Crazyflie firmware's collision avoidance in position mode (cell, box, step to
 * the right near a wall, stay if the cell is empty); the projection is this project's own solver
 * with a stiff penalty instead of Dykstra's sweeps. */
#include <math.h>

#include "internal.h"
#include "solver.h"

#define STIFFNESS 1e6 /* violates a wall by (pull in m) / STIFFNESS */
#define TOLERANCE                                                                                  \
    1e-4 /* m, a wall violated by more than this: the cell is empty (as in the firmware) */

/* Walls a.x <= c of the cell around the own position, unit normals, stored as n = -a, b = -c;
 * returns how many. */
static int bvc_walls(const avoid_query *q)
{
    const dtsa_avoid_params *params = q->params;
    const int n = q->n;
    double *x = avoid_plane(q, PLANE_X), *y = avoid_plane(q, PLANE_Y), *z = avoid_plane(q, PLANE_Z);
    double *b = avoid_plane(q, PLANE_B);
    const double side = params->horizon * params->v_max;
    int m = 0;
    for (int j = 0; j < n; j++) {
        if (j == q->self) continue;
        double dx = q->others_p[j] - q->position[0];
        double dy = q->others_p[n + j] - q->position[1];
        double dz = q->others_p[2 * n + j] - q->position[2];
        if (!(dx * dx + dy * dy + dz * dz < (double)INFINITY)) continue;
        /* in coordinates in which an agent is a ball of radius 1 */
        const double margin = q->age_s ? 0.5 * avoid_margin(params, q->age_s[j]) : 0.0;
        const double across = 1.0 / (params->radius + margin);
        const double up = across / params->stretch_z;
        if (dx == 0.0 && dy == 0.0 && dz == 0.0) dx = j > q->self ? 1e-9 : -1e-9;
        dx *= across;
        dy *= across;
        dz *= up;
        const double distance = sqrt(dx * dx + dy * dy + dz * dz);
        const double ax = dx * across / distance, ay = dy * across / distance,
                     az = dz * up / distance;
        const double norm = sqrt(ax * ax + ay * ay + az * az);
        const double wall = (0.5 * distance - 1.0) / norm;
        if (wall > 2.0 * side) /* beyond the box's corners (sqrt(3) side) */
            continue;
        x[m] = -ax / norm;
        y[m] = -ay / norm;
        z[m] = -az / norm;
        b[m] = -wall;
        m++;
    }
    for (int face = 0; face < 6; face++) {
        const double sign = face & 1 ? 1.0 : -1.0;
        x[m] = face / 2 == 0 ? sign : 0.0;
        y[m] = face / 2 == 1 ? sign : 0.0;
        z[m] = face / 2 == 2 ? sign : 0.0;
        b[m] = -side;
        m++;
    }
    return m;
}

/* How far one can go along `d` before the first wall, as a share of d; at least 0. */
static double bvc_share(const avoid_query *q, int m, const double d[3])
{
    const double *x = avoid_plane(q, PLANE_X), *y = avoid_plane(q, PLANE_Y),
                 *z = avoid_plane(q, PLANE_Z);
    const double *b = avoid_plane(q, PLANE_B);
    double share = (double)INFINITY;
    for (int k = 0; k < m; k++) {
        const double along = x[k] * d[0] + y[k] * d[1] + z[k] * d[2];
        if (along < 0.0 && b[k] / along < share) share = b[k] / along;
    }
    return share > 0.0 ? share : 0.0;
}

AVOID_INLINE void bvc_body(const avoid_query *q, double command[3])
{
    const dtsa_avoid_params *params = q->params;
    double *x = avoid_plane(q, PLANE_X), *y = avoid_plane(q, PLANE_Y), *z = avoid_plane(q, PLANE_Z);
    double *b = avoid_plane(q, PLANE_B);
    double goal[3], target[3];
    for (int axis = 0; axis < 3; axis++)
        goal[axis] = target[axis] = q->goal[axis] - q->position[axis];
    const int m = bvc_walls(q);
    const int blocks = (m + LANES - 1) / LANES;
    for (int k = m; k < LANES * blocks; k++) {
        x[k] = y[k] = z[k] = 0.0;
        b[k] = -1.0;
    }
    const double share = bvc_share(q, m, goal);
    int inside = 1; /* the own position is in its cell */
    for (int k = 0; k < m; k++) inside &= b[k] <= 0.0;
    if (!(inside && share >= 1.0)) {
        const double wall = share * sqrt(goal[0] * goal[0] + goal[1] * goal[1] + goal[2] * goal[2]);
        if (wall <= params->sidestep) {
            const double amount = (1.0 - wall / params->sidestep) * (1.0 - wall / params->sidestep);
            goal[0] += amount * target[1];
            goal[1] -= amount * target[0];
        }
        const soft_problem problem = {
            .blocks = blocks,
            .x = x,
            .y = y,
            .z = z,
            .b = b,
            .bits = avoid_plane(q, PLANE_BITS),
            .rho = STIFFNESS,
            .wish = goal,
        };
        soft_minimise(&problem, target);
        for (int k = 0; k < m; k++) {
            if (x[k] * target[0] + y[k] * target[1] + z[k] * target[2] < b[k] - TOLERANCE) {
                target[0] = target[1] = target[2] = 0.0; /* the cell is empty: stay */
                break;
            }
        }
    }
    for (int axis = 0; axis < 3; axis++) command[axis] = params->gain * target[axis];
}

static void bvc_baseline(const avoid_query *query, double command[3]) { bvc_body(query, command); }

AVOID_AVX2 static void bvc_avx2(const avoid_query *query, double command[3])
{
    bvc_body(query, command);
}

void avoid_bvc(const avoid_query *query, double command[3])
{
    if (avoid_level_in_force > 0)
        bvc_avx2(query, command);
    else
        bvc_baseline(query, command);
}
