// Own declarations of functions that the documentation of the Crazyflie firmware names: apps are compiled against them
// for this machine. No text of the firmware is in here.
#pragma once

#include "stabilizer_types.h"

// What the high-level commander does; disabled it wants motors neither on nor off.
enum trajectory_state {
    TRAJECTORY_STATE_IDLE = 0,
    TRAJECTORY_STATE_FLYING = 1,
    TRAJECTORY_STATE_LANDING = 3,
    TRAJECTORY_STATE_DISABLED = 4,
};

int crtpCommanderHighLevelDisable(void);
enum trajectory_state crtpCommanderHighLevelGetPlannerState(void);
int crtpCommanderHighLevelTakeoff(float height_m, float duration_s);
int crtpCommanderHighLevelTakeoffYaw(float height_m, float duration_s, float yaw);
int crtpCommanderHighLevelLand(float height_m, float duration_s);
int crtpCommanderHighLevelLandYaw(float height_m, float duration_s, float yaw);
int crtpCommanderHighLevelStop(void);
int crtpCommanderHighLevelGoTo(float x, float y, float z, float yaw, float duration_s,
                               bool relative);
bool crtpCommanderHighLevelIsStopped(void);
bool crtpCommanderHighLevelIsTrajectoryFinished(void);
