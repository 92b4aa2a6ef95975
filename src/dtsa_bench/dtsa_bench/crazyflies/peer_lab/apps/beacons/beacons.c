// Every vehicle broadcasts its state at a fixed rate, whether others send or not: what the scheme `beacons` does.
#include <string.h>

#include "FreeRTOS.h"
#include "app.h"
#include "configblock.h"
#include "log.h"
#include "param.h"
#include "radiolink.h"
#include "task.h"
#include "usec_time.h"

#define PORT 5

typedef struct {
    uint8_t id;
    uint8_t count;
    uint32_t ms;
    int16_t state[6]; // mm, mm/s
    uint8_t rest[6];
} __attribute__((packed)) Beacon;

static uint16_t period_ms = 120;
static uint16_t jitter_ms;
static uint32_t heard;
static uint8_t last;

static void hear(P2PPacket *packet)
{
    if (packet->port != PORT || packet->size != sizeof(Beacon)) return;
    heard++;
    last = packet->data[0];
}

// Bits that look random: xorshift, begun with the id and the time of the start.
static uint32_t next(uint32_t *seed)
{
    *seed ^= *seed << 13;
    *seed ^= *seed >> 17;
    *seed ^= *seed << 5;
    return *seed;
}

void appMain(void)
{
    static P2PPacket packet;
    static const char *const names[6] = {"x", "y", "z", "vx", "vy", "vz"};
    logVarId_t ids[6];
    for (int i = 0; i < 6; i++) ids[i] = logGetVarId("stateEstimate", names[i]);
    Beacon beacon = {.id = (uint8_t)configblockGetRadioAddress()};
    uint32_t seed = 2654435761u * (beacon.id + 1u);
    p2pRegisterCB(hear);
    packet.port = PORT;
    packet.size = sizeof beacon;
    vTaskDelay(M2T(next(&seed) %
                   period_ms)); // vehicles that are switched on together do not send together
    TickType_t due = xTaskGetTickCount();
    for (;;) {
        beacon.count++;
        beacon.ms = (uint32_t)(usecTimestamp() / 1000);
        for (int i = 0; i < 6; i++) beacon.state[i] = (int16_t)(1000.0f * logGetFloat(ids[i]));
        memcpy(packet.data, &beacon, sizeof beacon);
        radiolinkSendP2PPacketBroadcast(&packet);
        TickType_t wait = period_ms;
        if (jitter_ms) wait += next(&seed) % (2u * jitter_ms + 1u) - jitter_ms;
        vTaskDelayUntil(&due, M2T(wait));
    }
}

PARAM_GROUP_START(beacons)
PARAM_ADD(PARAM_UINT16, period, &period_ms)
PARAM_ADD(PARAM_UINT16, jitter, &jitter_ms)
PARAM_GROUP_STOP(beacons)

LOG_GROUP_START(beacons)
LOG_ADD(LOG_UINT32, heard, &heard)
LOG_ADD(LOG_UINT8, last, &last)
LOG_GROUP_STOP(beacons)
