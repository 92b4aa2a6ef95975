// Own declarations of functions that the documentation of the Crazyflie firmware names: apps are compiled against them
// for this machine. No text of the firmware is in here.
#pragma once

#include <stdbool.h>
#include <stdint.h>

uint16_t supervisorGetInfoBitfield(void);
bool supervisorAreMotorsAllowedToRun(void);
bool supervisorCanArm(void);
bool supervisorCanFly(void);
bool supervisorIsArmed(void);
bool supervisorIsCrashed(void);
bool supervisorIsFlying(void);
bool supervisorIsLocked(void);
bool supervisorIsTumbled(void);
bool supervisorRequestArming(bool arm);
bool supervisorRequestCrashRecovery(bool recover);
