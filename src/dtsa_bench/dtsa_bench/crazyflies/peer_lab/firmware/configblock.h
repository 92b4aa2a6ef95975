// Own declarations of functions that the documentation of the Crazyflie firmware names: apps are compiled against them
// for this machine. No text of the firmware is in here.
#pragma once

#include <stdint.h>

int configblockGetRadioChannel(void);
int configblockGetRadioSpeed(void);
uint64_t configblockGetRadioAddress(void);
