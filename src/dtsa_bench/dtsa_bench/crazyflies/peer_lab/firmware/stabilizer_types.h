// Own declarations of functions that the documentation of the Crazyflie firmware names: apps are compiled against them
// for this machine. No text of the firmware is in here.
#pragma once

#include <stdbool.h>
#include <stdint.h>

typedef struct attitude_s {
    uint32_t timestamp;
    float roll;
    float pitch;
    float yaw;
} attitude_t;

typedef struct vec3_s {
    uint32_t timestamp;
    float x;
    float y;
    float z;
} point_t;
typedef struct vec3_s vector_t;
typedef struct vec3_s velocity_t;
typedef struct vec3_s acc_t;
typedef struct vec3_s jerk_t;

typedef struct quaternion_s {
    union {
        struct {
            float q0;
            float q1;
            float q2;
            float q3;
        };
        struct {
            float x;
            float y;
            float z;
            float w;
        };
    };
} quaternion_t;

typedef enum { modeDisable = 0, modeAbs, modeVelocity } stab_mode_t;

typedef struct {
    stab_mode_t x;
    stab_mode_t y;
    stab_mode_t z;
    stab_mode_t roll;
    stab_mode_t pitch;
    stab_mode_t yaw;
    stab_mode_t quat;
} setpoint_mode_t;

// What the vehicle is to do; `mode` says which fields count.
typedef struct setpoint_s {
    uint32_t timestamp;
    attitude_t attitude;     // deg
    attitude_t attitudeRate; // deg/s
    quaternion_t attitudeQuaternion;
    float thrust;
    point_t position;    // m
    velocity_t velocity; // m/s
    acc_t acceleration;  // m/s^2
    jerk_t jerk;         // m/s^3
    bool velocity_body;  // the velocity is given in the vehicle's own axes
    setpoint_mode_t mode;
} setpoint_t;

typedef struct state_s {
    attitude_t attitude;
    quaternion_t attitudeQuaternion;
    point_t position;
    velocity_t velocity;
    acc_t acc;
} state_t;
