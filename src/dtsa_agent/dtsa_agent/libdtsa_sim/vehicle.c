#include "vehicle.h"

#include <math.h>

/* One axis triple. Every operation is rounded by itself (no contraction), so the scalar and the
 * vectorised loop agree. */
static inline void step_one(double tau, double a_max, double dt, double *px, double *py, double *pz,
                            double *vx, double *vy, double *vz, double cx, double cy, double cz)
{
    double ax = (cx - *vx) / tau;
    double ay = (cy - *vy) / tau;
    double az = (cz - *vz) / tau;
    double norm = sqrt(ax * ax + ay * ay + az * az);
    double scale = norm > a_max ? a_max / norm : 1.0;
    double gain = dt * scale;
    /* velocity first, then position with the new velocity (semi-implicit Euler); estimator `intent`
     * relies on it */
    *vx += gain * ax;
    *vy += gain * ay;
    *vz += gain * az;
    *px += dt * *vx;
    *py += dt * *vy;
    *pz += dt * *vz;
}

void vehicle_step(const vehicle_params *params, double dt, double *position, double *velocity,
                  const double *command, int stride)
{
    step_one(params->tau, params->a_max, dt, &position[0], &position[stride], &position[2 * stride],
             &velocity[0], &velocity[stride], &velocity[2 * stride], command[0], command[stride],
             command[2 * stride]);
}

void vehicle_step_all(const vehicle_params *params, double dt, int n, double *position,
                      double *velocity, const double *command)
{
    const double tau = params->tau;
    const double a_max = params->a_max;
    double *restrict px = position, *restrict py = position + n, *restrict pz = position + 2 * n;
    double *restrict vx = velocity, *restrict vy = velocity + n, *restrict vz = velocity + 2 * n;
    const double *restrict cx = command, *restrict cy = command + n, *restrict cz = command + 2 * n;
    for (int k = 0; k < n; k++)
        step_one(tau, a_max, dt, &px[k], &py[k], &pz[k], &vx[k], &vy[k], &vz[k], cx[k], cy[k],
                 cz[k]);
}
