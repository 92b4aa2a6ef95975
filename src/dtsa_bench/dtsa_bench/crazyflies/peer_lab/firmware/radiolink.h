// Own declarations of functions that the documentation of the Crazyflie firmware names: apps are compiled against them
// for this machine. No text of the firmware is in here.
#pragma once

#include <stdbool.h>
#include <stdint.h>

#define P2P_MAX_DATA_SIZE 60

// A peer-to-peer packet: `size` bytes of data, a port, and with what was received its strength.
typedef struct _P2PPacket {
    uint8_t size;
    uint8_t rssi; // 40 means -40 dBm
    union {
        struct {
            uint8_t port;
            uint8_t data[P2P_MAX_DATA_SIZE];
        };
        uint8_t raw[P2P_MAX_DATA_SIZE + 1];
    };
} __attribute__((packed)) P2PPacket;

typedef void (*P2PCallback)(P2PPacket *);

bool radiolinkSendP2PPacketBroadcast(P2PPacket *packet);
void p2pRegisterCB(P2PCallback callback);
