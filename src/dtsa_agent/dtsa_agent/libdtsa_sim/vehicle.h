/* How a quadcopter answers a velocity command: point mass with first-order response and limited
 * acceleration. */
#ifndef DTSA_VEHICLE_H
#define DTSA_VEHICLE_H

typedef struct {
    double tau;   /* s, time constant of the velocity response */
    double a_max; /* m/s^2, largest acceleration (norm) */
} vehicle_params;

/* One integration step of dt seconds for one vehicle; position and velocity (3 values, `stride`
 * doubles apart) are updated in place. command: m/s, 3 values, same stride. Semi-implicit Euler:
 * the position moves with the new velocity. */
void vehicle_step(const vehicle_params *params, double dt, double *position, double *velocity,
                  const double *command, int stride);

/* The same bits for n vehicles whose states are planes (3, n), faster than n calls. */
void vehicle_step_all(const vehicle_params *params, double dt, int n, double *position,
                      double *velocity, const double *command);

#endif
