// Own declarations of functions that the documentation of the Crazyflie firmware names: apps are compiled against them
// for this machine. No text of the firmware is in here.
#pragma once

#include "usec_time.h"

// Priorities of tasks that matter to an app; an app has 0.
#define SYSLINK_TASK_PRI 3
#define PARAM_TASK_PRI 1
