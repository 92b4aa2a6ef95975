/* Costs of the app on board: onboard/app.c runs as it is, on board mps2-an386 (see mps2.c), among
 * others that run the same station. The firmware's functions are here: they hand over what the air
 * carries, let time pass, and count instructions and stack of each turn of the app's loop.
 *
 * Times are us. A turn begins where the app looks for a packet of the ground. */
#include <setjmp.h>
#include <stdio.h>
#include <stdlib.h>

#include "app.c"
#include "core.h"

enum {
    TURN_US = 20,     /* from one turn of the loop to the next while it waits awake */
    FLIGHT_US = 1500, /* from the order to send to the arrival */
    OVERLAP_US = 500, /* frames that begin so close to each other are lost */
    OTHERS = AGENTS_MAX - 1,
    WORDS = 2048,
    PAINT = 0x5a5a5a5a
};
enum { DID_HEAR = 1, DID_DECIDE = 2, DID_SEND = 4, DID_STEER = 8, KINDS = 16 };
static const double LOSS = 0.1;

static volatile uint32_t *const SYSTICK_VALUE = (volatile uint32_t *)0xe000e018;

typedef struct cost {
    uint32_t most, count;
    uint64_t sum;
} cost;

static uint64_t clock_us, last_end_us, drawn;
static uint32_t begun, deepest;
static uint32_t *stack_top;
static int what, counted;
static uint32_t slot_sum;
static cost turns[KINDS], slots, idle;
static jmp_buf over;

/* The others: agent and station each, and whether they begin together with the app's agent. */
static struct {
    dtsa_config config;
    dtsa_agent *agent;
    dtsa_station *station;
    int64_t moved_slot;
    int awaits_begin;
    double agent_memory[AGENT_BYTES / sizeof(double)],
        station_memory[STATION_BYTES / sizeof(double)];
} others[OTHERS];
static double place_of[AGENTS_MAX][3], speed_of[AGENTS_MAX][3];

/* ---- the air: one frame at a time, in flight ---- */

static struct {
    uint64_t start;
    int from, length, lost, there;
    uint8_t data[DTSA_FRAME_MAX];
} in_flight;

static reception received[4];
static int waiting;

static void emit(int from, const uint8_t *data, int length)
{
    if (in_flight.there && clock_us - in_flight.start < OVERLAP_US) {
        in_flight.lost = 1;
        return;
    }
    in_flight.there = 1;
    in_flight.lost = 0;
    in_flight.start = clock_us;
    in_flight.from = from;
    in_flight.length = length;
    memcpy(in_flight.data, data, (size_t)length);
}

static void arrive(void)
{
    if (!in_flight.there || clock_us < in_flight.start + FLIGHT_US) return;
    in_flight.there = 0;
    for (int k = 0; k < agents && !in_flight.lost; k++) {
        if (k == in_flight.from || draw_uniform(77, drawn++) < LOSS) continue;
        if (k > 0) {
            dtsa_station_receive(others[k - 1].station, in_flight.data, in_flight.length, now_ns());
        } else if (waiting < 4) {
            received[waiting].us = clock_us;
            received[waiting].length = (uint8_t)in_flight.length;
            memcpy(received[waiting++].data, in_flight.data, (size_t)in_flight.length);
        }
    }
}

/* Agent and station of the k-th of the swarm; begins_ns as in app.c. */
static void start_other(int k, int which, int64_t begins_ns)
{
    const dtsa_station_settings settings = station_settings(k + 1, begins_ns);
    others[k - 1].config = config;
    others[k - 1].config.policy = which;
    others[k - 1].agent =
        dtsa_agent_start(others[k - 1].agent_memory, AGENT_BYTES, &others[k - 1].config, k + 1);
    if (!others[k - 1].agent) exit(3);
    const dtsa_station_agent ours = dtsa_station_agent_of(others[k - 1].agent);
    others[k - 1].station =
        dtsa_station_start(others[k - 1].station_memory, STATION_BYTES, &settings, &ours, now_ns());
    if (!others[k - 1].station) exit(4);
    others[k - 1].moved_slot = -1;
    others[k - 1].awaits_begin = !begins_ns && beginSlot > 0;
}

/* The others, once each. */
static void live(void)
{
    arrive();
    for (int k = 1; k < agents; k++) {
        uint8_t datagram[DTSA_DATAGRAM_MAX];
        int length = 0;
        dtsa_agent_set_state(others[k - 1].agent, place_of[k], speed_of[k]);
        dtsa_station_step(others[k - 1].station, now_ns(), datagram, &length);
        if (length > 0) {
            emit(k, datagram, length);
            dtsa_station_sent(others[k - 1].station, now_ns(), 1);
        }
        const int64_t slot = dtsa_station_slot(others[k - 1].station);
        if (others[k - 1].awaits_begin && slot + 1 >= (int64_t)beginSlot)
            start_other(k, policy, dtsa_station_slot_start(others[k - 1].station, beginSlot));
        if (slot < 0 || slot == others[k - 1].moved_slot) continue;
        others[k - 1].moved_slot = slot;
        if (dtsa_station_hovers(others[k - 1].station) == DTSA_FLIES)
            dtsa_agent_command(others[k - 1].agent, slot, 0, speed_of[k]);
        else
            memset(speed_of[k], 0, sizeof speed_of[k]);
        for (int i = 0; i < 3; i++) place_of[k][i] += speed_of[k][i] * (double)slotUs * 1e-6;
    }
}

/* ---- turns ---- */

static __attribute__((noinline)) uint32_t *here(void)
{
    uint32_t *sp;
    __asm volatile("mov %0, sp" : "=r"(sp));
    return sp;
}

static void add(cost *c, uint32_t instructions)
{
    if (instructions > c->most) c->most = instructions;
    c->sum += instructions;
    c->count++;
}

/* A turn, or the part of it after a sleep, is over. */
static void end_turn(void)
{
    const uint32_t instructions = ((begun - *SYSTICK_VALUE) & 0xffffff) * 5 / 4;
    uint32_t *word = stack_top - WORDS;
    while (word < stack_top && *word == PAINT) word++;
    if ((uint32_t)(stack_top - word) * 4 > deepest) deepest = (uint32_t)(stack_top - word) * 4;
    /* It counts once the app steers, by this policy. */
    if (guard.mode != SAFETY_FLY || awaitsBegin) return;
    if (!what) {
        add(&idle, instructions);
        return;
    }
    add(&turns[what], instructions);
    if (what & DID_DECIDE) {
        if (counted++) add(&slots, slot_sum);
        slot_sum = 0;
    }
    slot_sum += instructions;
}

static void begin_turn(void)
{
    uint32_t *sp = here();
    what = 0;
    for (uint32_t *word = stack_top - WORDS; word < sp - 16; word++) *word = PAINT;
    begun = *SYSTICK_VALUE;
}

static int64_t slot_before;

/* The app is at a place where time passes: until something has arrived, or so many us are over. */
static void pass(uint64_t us, int until_heard)
{
    const uint64_t end = clock_us + us;
    const int64_t slot = dtsa_station_slot(station);
    if (slot != slot_before) what |= DID_DECIDE;
    slot_before = slot;
    end_turn();
    do {
        clock_us += TURN_US;
        live();
    } while (clock_us < end && !(until_heard && waiting));
    if (counted > SLOTS || clock_us > last_end_us) longjmp(over, 1);
    begin_turn();
}

/* ---- the firmware ---- */

uint64_t usecTimestamp(void) { return clock_us; }

size_t appchannelReceiveDataPacket(void *data, size_t length, int timeout)
{
    (void)data, (void)length, (void)timeout;
    pass(TURN_US, 0);
    return 0;
}

BaseType_t xQueueReceive(QueueHandle_t q, void *item, TickType_t ticks)
{
    (void)q;
    if (ticks > 0 && !waiting) pass(1000, 1); /* it sleeps: a tick at most */
    if (!waiting) return pdFALSE;
    memcpy(item, &received[--waiting], sizeof received[0]);
    what |= DID_HEAR;
    return pdTRUE;
}

bool radiolinkSendP2PPacketBroadcast(P2PPacket *packet)
{
    what |= DID_SEND;
    emit(0, packet->data, packet->size);
    return true;
}

void commanderSetSetpoint(setpoint_t *setpoint, int priority)
{
    (void)priority;
    what |= DID_STEER;
    speed_of[0][0] = (double)setpoint->velocity.x;
    speed_of[0][1] = (double)setpoint->velocity.y;
    speed_of[0][2] = (double)setpoint->velocity.z;
    for (int i = 0; i < 3; i++) place_of[0][i] += speed_of[0][i] * 0.01;
}

float logGetFloat(logVarId_t id)
{
    if (id < 3) return (float)place_of[0][id] + (id == 2 ? height : 0.0f);
    return (float)speed_of[0][id - 3];
}

logVarId_t logGetVarId(const char *group, const char *name)
{
    (void)group;
    return (logVarId_t)((name[0] == 'v' ? 3 : 0) + name[name[0] == 'v'] - 'x');
}

void p2pRegisterCB(P2PCallback callback) { (void)callback; }
int appchannelSendDataPacket(void *data, size_t length) { return (void)data, (int)length; }
uint64_t configblockGetRadioAddress(void) { return 0xe7e7e7e701; }
int commanderGetActivePriority(void) { return COMMANDER_PRIORITY_LOWEST; }
enum trajectory_state crtpCommanderHighLevelGetPlannerState(void)
{
    return TRAJECTORY_STATE_DISABLED;
}
int crtpCommanderHighLevelDisable(void) { return 0; }
int crtpCommanderHighLevelLand(float z, float s) { return (void)z, (void)s, 0; }
int crtpCommanderHighLevelGoTo(float x, float y, float z, float yaw, float s, bool relative)
{
    return (void)x, (void)y, (void)z, (void)yaw, (void)s, (void)relative, 0;
}
bool supervisorCanFly(void) { return true; }
bool supervisorIsFlying(void) { return true; }
float pmGetBatteryVoltage(void) { return 4.0f; }
BaseType_t xQueueSend(QueueHandle_t q, const void *item, TickType_t ticks)
{
    return (void)q, (void)item, (void)ticks, pdTRUE;
}
QueueHandle_t xQueueCreateStatic(UBaseType_t n, UBaseType_t size, uint8_t *storage,
                                 StaticQueue_t *memory)
{
    return (void)n, (void)size, (void)storage, (void)memory, (QueueHandle_t)1;
}
void labRegister(int parameters, const char *group, const struct labVariable *variables, int count)
{
    (void)parameters, (void)group, (void)variables, (void)count;
}

/* ---- a flight ---- */

static void prepare(int n, int p)
{
    agents = (uint8_t)n;
    policy = (uint8_t)p;
    beginSlot = p == DTSA_POLICY_DTSA ? (uint32_t)(20 * n) : 0; /* nobody can join it later */
    enable = 1;
    started = 0;
    clock_us = 1000000;
    last_end_us = clock_us + ((uint64_t)SLOTS + 1000) * slotUs;
    waiting = in_flight.there = counted = 0;
    drawn = 0;
    slot_sum = 0;
    slot_before = -1;
    memset(turns, 0, sizeof turns);
    memset(&slots, 0, sizeof slots);
    memset(&idle, 0, sizeof idle);
    deepest = 0;
    limits.news_s = limits.rests_s = 60.0f; /* it flies on, however many frames are lost */
    limits.low[0] = limits.low[1] = -9.0f;
    limits.high[0] = limits.high[1] = 9.0f;
    for (int k = 0; k < n; k++) { /* a wavy square; most cross it, two rest */
        const double side = 0.8 * (k / 4 + 1), far = k < n - 2 ? -1.0 : 1.0;
        const double at[3] = {k & 1 ? side : -side, k & 2 ? 2.5 : -2.5, 0.1 * (k % 5)};
        for (int i = 0; i < 3; i++) {
            starts[i * AGENTS_MAX + k] = place_of[k][i] = at[i];
            targets[i * AGENTS_MAX + k] = i < 2 ? far * at[i] : at[i];
            speed_of[k][i] = 0.0;
        }
    }
    obey((const uint8_t *)"S", 1);
    for (int k = 1; k < n; k++) start_other(k, config.policy, 0);
}

static void show(const cost *c)
{
    printf(" %lu %lu", (unsigned long)(c->count ? c->sum / c->count : 0), (unsigned long)c->most);
}

int main(void)
{
#ifdef SAMPLE
    static const int POLICIES[] = {DTSA_POLICY_LEASE}, SIZES[] = {AGENTS_MAX};
#else
    static const int POLICIES[] = {DTSA_POLICY_TDMA, DTSA_POLICY_DTSA, DTSA_POLICY_LEASE};
    static const int SIZES[] = {12, AGENTS_MAX};
#endif
    static volatile unsigned i, j;
    for (i = 0; i < sizeof POLICIES / sizeof POLICIES[0]; i++)
        for (j = 0; j < sizeof SIZES / sizeof SIZES[0]; j++) {
            guard.mode = SAFETY_OFF;
            prepare(SIZES[j], POLICIES[i]);
            stack_top = here();
            begin_turn();
            if (!setjmp(over)) appMain();
            printf("%s %d %d %lu", dtsa_names(0)->names[POLICIES[i]], SIZES[j], counted - 1,
                   (unsigned long)deepest);
            show(&turns[DID_HEAR]), show(&turns[DID_DECIDE]);
            show(&turns[DID_SEND]), show(&turns[DID_STEER]);
            show(&slots), show(&idle);
            const dtsa_station_settings settings = station_settings(1, 0);
            printf(" %d\n", dtsa_datagram_length(&settings));
        }
    return 0;
}
