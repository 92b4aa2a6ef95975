// Own declarations of functions that the documentation of the Crazyflie firmware names: apps are compiled against them
// for this machine. No text of the firmware is in here.
#pragma once

#include "stabilizer_types.h"

int crtpCommanderHighLevelTakeoff(float height_m, float duration_s);
int crtpCommanderHighLevelTakeoffYaw(float height_m, float duration_s, float yaw);
int crtpCommanderHighLevelLand(float height_m, float duration_s);
int crtpCommanderHighLevelLandYaw(float height_m, float duration_s, float yaw);
int crtpCommanderHighLevelStop(void);
int crtpCommanderHighLevelGoTo(float x, float y, float z, float yaw, float duration_s,
                               bool relative);
bool crtpCommanderHighLevelIsStopped(void);
bool crtpCommanderHighLevelIsTrajectoryFinished(void);
