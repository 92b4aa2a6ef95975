// A static token ring that answers every packet: what the scheme `dtr` does. The vehicle with the token sends its state to
// each other one in turn, and each acknowledges; then it offers the token to the next one, which asks for it and gets it.
#include <string.h>

#include "FreeRTOS.h"
#include "app.h"
#include "configblock.h"
#include "log.h"
#include "param.h"
#include "radiolink.h"
#include "static_mem.h"
#include "task.h"

#define PORT 15
#define SILENCE_MS 4000
#define DATA_SIZE 24 // the state, and room for what else others need

enum { DATA, TOKEN, CLEAR, REQUEST, ACKNOWLEDGE };    // kinds of packets
enum { IDLE, WAIT_CLEAR, WAIT_REQUEST, WAIT_ANSWER }; // what it waits for

typedef struct {
    uint8_t size, kind, source, target, data_size; // sizes in bytes
} Head;

static uint8_t count = 12;
static uint16_t resend_ms = 20;
static uint32_t turns;

static uint8_t own, state, target;
static int kind = -1; // of the packet that is sent again until it is answered; -1: none
static logVarId_t ids[6];

STATIC_MEM_QUEUE_ALLOC(heads, 16, sizeof(Head));
static QueueHandle_t heads;

static void hear(P2PPacket *packet)
{
    if (packet->port != PORT || packet->size < sizeof(Head)) return;
    xQueueSend(heads, packet->data, 0);
}

static uint8_t after(uint8_t id) { return id % count + 1; }

static uint8_t before(uint8_t id) { return (id + count - 2) % count + 1; }

static void send(uint8_t what, uint8_t to)
{
    static P2PPacket packet;
    uint8_t data_size = what == DATA ? DATA_SIZE : 0;
    Head head = {sizeof head + data_size, what, own, to, data_size};
    packet.port = PORT;
    packet.size = sizeof head;
    memcpy(packet.data, &head, sizeof head);
    if (what == DATA) {
        for (int i = 0; i < 6; i++) {
            int16_t value = (int16_t)(1000.0f * logGetFloat(ids[i]));
            memcpy(packet.data + packet.size, &value, sizeof value);
            packet.size += sizeof value;
        }
        packet.size = sizeof head + DATA_SIZE;
    }
    radiolinkSendP2PPacketBroadcast(&packet);
}

// Sends a packet, and again until the state changes.
static void begin(uint8_t what, uint8_t to, uint8_t next_state)
{
    state = next_state;
    kind = next_state == IDLE ? -1 : what;
    target = to;
    send(what, to);
}

static void answer(const Head *head)
{
    uint8_t mine = head->target == own;
    if (state == IDLE && head->kind == DATA && mine) {
        begin(ACKNOWLEDGE, head->source, IDLE);
    } else if (state == IDLE && head->kind == TOKEN && head->source == before(own)) {
        begin(REQUEST, head->source, WAIT_CLEAR);
    } else if ((state == IDLE || state == WAIT_REQUEST) && head->kind == REQUEST &&
               head->source == after(own)) {
        begin(CLEAR, head->source, IDLE);
    } else if (state == WAIT_CLEAR && head->kind == CLEAR && head->source == before(own)) {
        begin(DATA, after(own), WAIT_ANSWER);
        turns++;
    } else if (state == WAIT_ANSWER && head->kind == ACKNOWLEDGE && mine) {
        uint8_t next = after(target);
        if (next == own)
            begin(TOKEN, after(own), WAIT_REQUEST);
        else
            begin(DATA, next, WAIT_ANSWER);
    }
}

void appMain(void)
{
    static const char *const names[6] = {"x", "y", "z", "vx", "vy", "vz"};
    Head head;
    heads = STATIC_MEM_QUEUE_CREATE(heads);
    own = (uint8_t)configblockGetRadioAddress();
    for (int i = 0; i < 6; i++) ids[i] = logGetVarId("stateEstimate", names[i]);
    p2pRegisterCB(hear);
    vTaskDelay(M2T(2000)); // until all are there
    if (own == 1) begin(DATA, after(own), WAIT_ANSWER);
    TickType_t last = xTaskGetTickCount();
    for (;;) {
        if (xQueueReceive(heads, &head, kind < 0 ? M2T(100) : M2T(resend_ms)) == pdTRUE) {
            last = xTaskGetTickCount();
            answer(&head);
        } else if (kind >= 0) {
            send((uint8_t)kind, target);
        }
        if (own != 1 && xTaskGetTickCount() - last > M2T(SILENCE_MS)) {
            state = IDLE;
            kind = -1;
        }
    }
}

PARAM_GROUP_START(dtr)
PARAM_ADD(PARAM_UINT8, count, &count)
PARAM_ADD(PARAM_UINT16, resend, &resend_ms)
PARAM_GROUP_STOP(dtr)

LOG_GROUP_START(dtr)
LOG_ADD(LOG_UINT32, turns, &turns)
LOG_ADD(LOG_UINT8, state, &state)
LOG_GROUP_STOP(dtr)
