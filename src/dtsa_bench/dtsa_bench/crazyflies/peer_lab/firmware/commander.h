// Own declarations of functions that the documentation of the Crazyflie firmware names: apps are compiled against them
// for this machine. No text of the firmware is in here.
#pragma once

#include "stabilizer_types.h"

#define COMMANDER_PRIORITY_DISABLE 0
#define COMMANDER_PRIORITY_LOWEST 1
#define COMMANDER_PRIORITY_HIGHLEVEL 1
#define COMMANDER_PRIORITY_CRTP 2
#define COMMANDER_PRIORITY_EXTRX 3

void commanderSetSetpoint(setpoint_t *setpoint, int priority);
int commanderGetActivePriority(void);
void commanderRelaxPriority(void);
