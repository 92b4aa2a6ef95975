// Own declarations of functions that the documentation of the Crazyflie firmware names: apps are compiled against them
// for this machine. No text of the firmware is in here.
#pragma once

#include <stdbool.h>
#include <stddef.h>

#define APPCHANNEL_WAIT_FOREVER (-1)
#define APPCHANNEL_MTU 30

int appchannelSendDataPacket(void *data, size_t length);
void appchannelSendDataPacketBlock(void *data, size_t length);
size_t appchannelReceiveDataPacket(void *buffer, size_t max_length, int timeout_ms);
bool appchannelHasOverflowOccurred(void);
bool appchannelHasOverflowOccured(void);
