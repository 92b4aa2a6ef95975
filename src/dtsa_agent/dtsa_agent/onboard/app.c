/* The protocol as an app of a Crazyflie: what is between the firmware and the station and safety.c.
 *
 * How it is built and flown: docs/how-to/on-board.md. It was never flown on hardware.
 *
 * The ground sets the parameters dtsa.*, sends by the app channel where each agent starts and goes,
 * starts the agent, takes off by the high-level commander, and then sets dtsa.enable. */
#include <math.h>
#include <stdbool.h>
#include <string.h>

#include "FreeRTOS.h"
#include "app.h"
#include "app_channel.h"
#include "commander.h"
#include "configblock.h"
#include "crtp_commander_high_level.h"
#include "log.h"
#include "param.h"
#include "pm.h"
#include "queue.h"
#include "radiolink.h"
#include "static_mem.h"
#include "supervisor.h"
#include "task.h"
#include "usec_time.h"

#include "core.h"
#include "dtsa_station.h"
#include "safety.h"
#include "watch.h"

enum {
    AGENTS_MAX = 20,      /* N at most */
    AGENT_BYTES = 8704,   /* of an agent with so many */
    STATION_BYTES = 4096, /* ... and its station */
    EARLY_COUNT = 4,      /* frames of slots still to come */
    QUEUE_LENGTH = 16,    /* datagrams between the radio's task and this one */
    CONTROL_US = 10000,   /* from one set-point to the next */
    NEAR_US = 1500,       /* nearer than this to what is due it does not sleep */
    KEY_BYTES = 16
};
static const float DOWN_M_S = 0.4f; /* how fast it lands */

/* ---- what the ground sets and sees ---- */

static uint8_t mute, enable, goalsKnown = 1, agents = 12, policy = DTSA_POLICY_LEASE, p2pPort = 7,
                             started;
static uint8_t estimator = DTSA_ESTIMATE_LINEAR;
static uint16_t headerWord = 0x5444, steps = 1;
static uint32_t beginSlot, slotUs = 10000, flightUs = 1500, seed = 1;
static float height = 1.0f, vMax = 1.5f, pairRadius = 0.336f, horizon = 1.0f;
static safety_settings limits = {
    .news_s = 0.6f,
    .rests_s = 3.0f,
    .unheard_s = 0.5f,
    .land_s = 5.0f,
    .well_s = 0.5f,
    .battery_v = 3.2f,
    .sag_s = 2.0f,
    .low = {-2.0f, -2.0f, 0.2f},
    .high = {2.0f, 2.0f, 2.0f},
};

static uint32_t slotNow, digest, lost, sent, heard, unsent, refused;
static uint16_t lateUs;
static uint8_t chosen, reason, mode, why, timeState;
static float oldest, nearest;

/* ---- from the radio's task ---- */

typedef struct reception {
    uint64_t us;
    uint8_t length, data[DTSA_FRAME_MAX];
} reception;

STATIC_MEM_QUEUE_ALLOC(receptions, QUEUE_LENGTH, sizeof(reception));
static QueueHandle_t queue;

static void on_packet(P2PPacket *packet)
{
    reception r = {.us = usecTimestamp()};
    if (packet->port != p2pPort || packet->size > sizeof r.data) return;
    r.length = packet->size;
    memcpy(r.data, packet->data, packet->size);
    if (xQueueSend(queue, &r, 0) != pdTRUE) lost++;
}

/* ---- the agent ---- */

static dtsa_config config;
static dtsa_agent *agent;
static dtsa_station *station;
static dtsa_station_status status;
static double agent_memory[AGENT_BYTES / sizeof(double)],
    station_memory[STATION_BYTES / sizeof(double)];
static int own_id;
static safety guard;
static double starts[3 * AGENTS_MAX], targets[3 * AGENTS_MAX];
static uint8_t key[KEY_BYTES], sealed, ordered, awaitsBegin;
static uint64_t session, lots;
static int64_t heardLast; /* ns */
static float hold[3];     /* m, where it hovers */

static int64_t now_ns(void) { return (int64_t)usecTimestamp() * 1000; }

static void configure(dtsa_config *c)
{
    static double places[6 * AGENTS_MAX]; /* as many as there are: the three planes of libdtsa */
    const int n = agents;
    for (int i = 0; i < 3; i++)
        for (int k = 0; k < n; k++) {
            places[i * n + k] = starts[i * AGENTS_MAX + k];
            places[(3 + i) * n + k] = targets[i * AGENTS_MAX + k];
        }
    *c = (dtsa_config){
        .agents = n,
        .slot_s = (double)slotUs * 1e-6,
        .steps = steps,
        .policy = (int)policy,
        .estimator = estimator,
        .avoider = DTSA_AVOID_ORCA,
        .profile = policy == DTSA_POLICY_LEASE ? DTSA_PROFILE_EXTENDED : DTSA_PROFILE_PAPER,
        .epsilon = 0.5,
        .age_cap = 1.5,
        .boot_round = 1,
        .return_every = 20,
        .r_min = 0.3,
        .c_r = 1,
        .targets_known = goalsKnown,
        .gossip = 1,
        .position_step = 0.002,
        .key = lots,
        .avoid = {.v_max = (double)vMax,
                  .gain = 2.0,
                  .radius = (double)pairRadius,
                  .horizon = (double)horizon,
                  .softness = 30.0,
                  .bias = 0.2,
                  .period = 0.2},
        .lease = {policy == DTSA_POLICY_LEASE ? 3 : 5, 11, 1, 0.5, 1.0, 0, 15},
        .start = places,
        .target = places + 3 * n,
    };
}

/* To where the ground has said. Where goals change in flight none is known to be the last. */
static void fly_to(int k)
{
    const double goal[3] = {targets[k], targets[AGENTS_MAX + k], targets[2 * AGENTS_MAX + k]};
    dtsa_agent_set_goal(agent, goal, goalsKnown);
}

/* Of the station with this id. begins_ns: all start slot 0 then; 0: it listens. */
static dtsa_station_settings station_settings(int id, int64_t begins_ns)
{
    static const int LENGTHS[DTSA_PROFILE_COUNT] = {19, 23, EXTENDED_LENGTH};
    return (dtsa_station_settings){
        .id = id,
        .agents = agents,
        .anchor_every = config.lease.anchor_every,
        .main_every = config.lease.main_every,
        .slot_cycle = dtsa_slot_cycle(&config),
        .extended = config.profile == DTSA_PROFILE_EXTENDED,
        .frame_length = LENGTHS[config.profile],
        .position_step = config.position_step,
        .slot_ns = (int64_t)slotUs * 1000,
        .seed = seed,
        .key = sealed ? key : NULL,
        .key_length = KEY_BYTES,
        .session = session,
        .early_count = EARLY_COUNT,
        .begins = begins_ns ? DTSA_BEGINS_TOGETHER : DTSA_BEGINS_LISTENING,
        .origin_ns = begins_ns,
        .link = {.header = {(uint8_t)headerWord, (uint8_t)(headerWord >> 8)},
                 .header_length = sealed ? 0 : 2,
                 .says_late = !sealed,
                 .flight_ns = (int64_t)flightUs * 1000,
                 .trust_ns = 1000000},
    };
}

/* Makes agent and station. */
static const char *begin(int which, int64_t begins_ns)
{
    config.policy = which;
    const char *fault = dtsa_config_fault(&config);
    if (fault) return fault;
    const dtsa_station_settings settings = station_settings(own_id, begins_ns);
    if (dtsa_datagram_length(&settings) > DTSA_FRAME_MAX) return "profile";
    agent = dtsa_agent_start(agent_memory, sizeof agent_memory, &config, own_id);
    if (!agent) return "memory";
    const dtsa_station_agent ours = dtsa_station_agent_of(agent);
    station = dtsa_station_start(station_memory, sizeof station_memory, &settings, &ours, now_ns());
    if (!station) return "station";
    if (!awaitsBegin) observe(station, agent); /* what comes before is of another policy */
    fly_to(own_id - 1);
    dtsa_station_get_status(station, &status);
    return NULL;
}

static const char *start(void)
{
    own_id = (int)(configblockGetRadioAddress() & 0xff);
    if (agents < 1 || agents > AGENTS_MAX) return "agents";
    if (own_id < 1 || own_id > agents) return "id";
    if (slotUs < 1000) return "slot";
    if (estimator > DTSA_ESTIMATE_LINEAR) return "estimator";
    configure(&config);
    safety_reset(&guard);
    heardLast = INT64_MIN;
    ordered = 0;
    awaitsBegin = beginSlot > 0;
    return begin(awaitsBegin ? DTSA_POLICY_TDMA : policy, 0);
}

/* All have a common time: in slot beginSlot they begin with slot 0 and the policy that no agent can
 * join. An agent that comes later stays out: its slots are of another time. */
static void begin_together(void)
{
    if (!awaitsBegin || status.state == DTSA_LISTENING || status.slot + 1 < (int64_t)beginSlot)
        return;
    const int64_t origin = dtsa_station_slot_start(station, beginSlot);
    if (now_ns() < origin - (int64_t)slotUs * 200) return; /* the last frame before has come */
    awaitsBegin = 0;
    begin(policy, origin);
}

static void publish(void)
{
    const dtsa_decision d = dtsa_agent_decision(agent);
    slotNow = (uint32_t)status.slot;
    chosen = (uint8_t)d.chosen;
    reason = (uint8_t)d.reason;
    digest = d.digest;
    sent = status.sent;
    heard = status.heard;
    unsent = status.unsent;
    timeState = (uint8_t)status.state;
}

static void send(const uint8_t *data, int length)
{
    static P2PPacket packet;
    if (mute) return;
    packet.port = p2pPort;
    packet.size = (uint8_t)length;
    memcpy(packet.data, data, (size_t)length);
    radiolinkSendP2PPacketBroadcast(&packet);
}

/* ---- the ground ---- */

enum {
    ORDER_START = 'S',
    ORDER_FROM = 'F',
    ORDER_TO = 'T',
    ORDER_KEY = 'K',
    ORDER_LOTS = 'D',
    ORDER_LAND = 'L'
};

static bool place(double *planes, const uint8_t *data, size_t length)
{
    double at[3];
    const int k = (int)data[1] - 1;
    if (length != 2 + sizeof at || k < 0 || k >= AGENTS_MAX) return false;
    memcpy(at, data + 2, sizeof at);
    for (int i = 0; i < 3; i++) {
        if (!isfinite(at[i])) return false;
        planes[i * AGENTS_MAX + k] = at[i];
    }
    return true;
}

/* What the ground says; it hears the order's letter and 1, or 0 and why not. */
static void obey(const uint8_t *data, size_t length)
{
    /* What is said on the ground counts from the next start on. */
    const bool flies = guard.mode != SAFETY_OFF;
    const char *fault = strchr("FTKDSL", data[0]) ? "length" : "order";
    const bool changes = !goalsKnown && data[0] == ORDER_TO && data[1] == own_id;
    if (data[0] == ORDER_FROM && !flies && place(starts, data, length))
        fault = NULL;
    else if (data[0] == ORDER_TO && flies && !changes)
        fault = "goals known";
    else if (data[0] == ORDER_TO && place(targets, data, length)) {
        if (started && changes) fly_to(data[1] - 1);
        fault = NULL;
    } else if (data[0] == ORDER_LAND && length == 1)
        ordered = 1, fault = NULL;
    else if (data[0] == ORDER_KEY && !flies && length == 1 + KEY_BYTES + sizeof session) {
        memcpy(key, data + 1, KEY_BYTES);
        memcpy(&session, data + 1 + KEY_BYTES, sizeof session);
        sealed = 1;
        fault = NULL;
    } else if (data[0] == ORDER_LOTS && !flies && length == 1 + sizeof lots) {
        memcpy(&lots, data + 1, sizeof lots);
        fault = NULL;
    } else if (data[0] == ORDER_START && length == 1) {
        fault = flies ? "in flight" : start();
        started = !fault;
    }
    uint8_t answer[2 + 16] = {data[0], !fault};
    if (fault) strncpy((char *)answer + 2, fault, sizeof answer - 3);
    appchannelSendDataPacket(answer, fault ? 2 + strlen((char *)answer + 2) : 2);
}

static void listen_to_ground(void)
{
    uint8_t data[30];
    const size_t length = appchannelReceiveDataPacket(data, sizeof data, 0);
    if (length > 0) obey(data, length);
}

/* ---- the vehicle ---- */

static logVarId_t ids[6];

static void sense(double position[3], double velocity[3])
{
    for (int i = 0; i < 3; i++) {
        position[i] = (double)logGetFloat(ids[i]);
        velocity[i] = (double)logGetFloat(ids[3 + i]);
    }
}

static void set_point(const double velocity[3])
{
    setpoint_t s;
    memset(&s, 0, sizeof s);
    s.mode.yaw = modeVelocity;
    if (velocity) {
        s.mode.x = s.mode.y = s.mode.z = modeVelocity;
        s.velocity.x = (float)velocity[0];
        s.velocity.y = (float)velocity[1];
        s.velocity.z = (float)velocity[2];
    } else {
        s.mode.x = s.mode.y = s.mode.z = modeAbs;
        s.position.x = hold[0];
        s.position.y = hold[1];
        s.position.z = hold[2];
    }
    /* The lowest there is: whatever the ground commands wins. */
    commanderSetSetpoint(&s, COMMANDER_PRIORITY_LOWEST);
}

/* Of the others; their places and the own one are in the frame map. */
static void look_around(safety_view *v, const double place[3], int64_t now)
{
    const dtsa_table *t = agent->table;
    const int n = config.agents;
    float rests = 0.0f;
    oldest = 0.0f;
    nearest = INFINITY;
    for (int k = 0; k < n; k++) {
        if (k == own_id - 1) continue;
        const int64_t sent_slot = t->sent_slot[k];
        const float age_s = (float)(status.slot - sent_slot) * (float)slotUs * 1e-6f;
        float distance = 0.0f;
        if (sent_slot < 0)
            oldest = -1.0f;
        else if (!t->in_ap[k])
            rests = fmaxf(rests, age_s);
        else if (oldest >= 0.0f)
            oldest = fmaxf(oldest, age_s);
        if (sent_slot < 0) continue;
        for (int i = 0; i < 3; i++) {
            const float d = (float)(t->sent_p[i * n + k] - place[i]);
            distance += d * d;
        }
        nearest = fminf(nearest, sqrtf(distance));
    }
    v->oldest_s = oldest;
    v->rests_s = rests;
    v->unheard_s = heardLast == INT64_MIN ? -1.0f : (float)(now - heardLast) * 1e-9f;
    if (n == 1) v->unheard_s = v->oldest_s = 0.0f;
}

/* Where to fly, m/s, in the present slot; 0: nowhere, it hovers. */
static int fly(int64_t now, double command[3])
{
    if (status.hovers != DTSA_FLIES || status.slot < 0) return 0;
    const int64_t since = now - dtsa_station_slot_start(station, status.slot);
    const int64_t step = since < 0 ? 0 : since * steps / ((int64_t)slotUs * 1000);
    dtsa_agent_command(agent, status.slot, (int)(step < steps ? step : steps - 1), command);
    return 1;
}

/* The same for one that stays at a place (m, frame map) and gives way to those it has heard of. */
static int stay(int64_t now, const double place[3], double command[3])
{
    double there[3];
    memcpy(there, agent->goal, sizeof there);
    memcpy(agent->goal, place, sizeof there);
    const int flies = fly(now, command);
    memcpy(agent->goal, there, sizeof there);
    return flies;
}

/* Someone else steers: set-points of a higher priority, or the high-level commander. */
static int ground_steers(void)
{
    return commanderGetActivePriority() > COMMANDER_PRIORITY_LOWEST ||
           crtpCommanderHighLevelGetPlannerState() != TRAJECTORY_STATE_DISABLED;
}

static void land(const double position[3])
{
    const float height = (float)position[2] > 0.1f ? (float)position[2] : 0.1f;
    crtpCommanderHighLevelLand(0.0f, height / DOWN_M_S);
}

static void steer(const double position[3], const double place[3], int64_t now, float elapsed)
{
    const safety_mode before = guard.mode;
    safety_view view = {
        .enabled = enable,
        .ordered = ordered,
        /* While it steers; before that it is the ground that holds the vehicle in the air. */
        .ground = (before == SAFETY_FLY || before == SAFETY_HOVER) && ground_steers(),
        .can_fly = supervisorCanFly(),
        .in_air = supervisorIsFlying(),
        .newcomer = status.hovers != DTSA_FLIES,
        .battery_v = pmGetBatteryVoltage(),
        .position = {(float)position[0], (float)position[1], (float)position[2]},
    };
    double command[3];
    look_around(&view, place, now);
    const safety_mode next = safety_step(&guard, &limits, &view, elapsed);
    mode = (uint8_t)next;
    why = (uint8_t)guard.reason;
    if (next == SAFETY_FLY || next == SAFETY_HOVER) {
        if (before == SAFETY_OFF) crtpCommanderHighLevelDisable(); /* it takes over */
        if (next != before)
            for (int i = 0; i < 3; i++) hold[i] = (float)position[i];
        /* The others count on it to give way as they do: an agent whose state of another one is old still does. */
        const int gives_way = next == SAFETY_HOVER && guard.reason == SAFETY_OLD_NEWS;
        const double there[3] = {(double)hold[0], (double)hold[1],
                                 (double)hold[2] - (double)height}; /* frame map */
        const int flies =
            gives_way ? stay(now, there, command) : next == SAFETY_FLY && fly(now, command);
        set_point(flies ? command : NULL);
    } else if (next == SAFETY_LAND && before != SAFETY_LAND) {
        land(position);
    } else if (next == SAFETY_OFF && (before == SAFETY_FLY || before == SAFETY_HOVER) &&
               guard.reason == SAFETY_DISABLED && !view.ground) {
        /* The ground takes it back, hovering; unless it has commanded something else already. */
        crtpCommanderHighLevelGoTo((float)position[0], (float)position[1], (float)position[2], 0.0f,
                                   1.0f, false);
    }
    if (next == SAFETY_OFF && !enable) ordered = 0;
}

/* ---- the app ---- */

static void take_in(const reception *r)
{
    if (!started) return;
    if (dtsa_station_receive(station, r->data, r->length, (int64_t)r->us * 1000) == DTSA_ACCEPTED)
        heardLast = (int64_t)r->us * 1000;
    else
        refused++;
}

void appMain(void)
{
    static const char *const NAMES[] = {"x", "y", "z", "vx", "vy", "vz"};
    static uint8_t datagram[DTSA_FRAME_MAX];
    static reception r;
    uint64_t controlled = usecTimestamp();
    for (int i = 0; i < 6; i++) ids[i] = logGetVarId("stateEstimate", NAMES[i]);
    queue = STATIC_MEM_QUEUE_CREATE(receptions);
    p2pRegisterCB(on_packet);
    while (1) {
        double position[3], velocity[3]; /* world */
        int64_t due;
        int length = 0;
        listen_to_ground();
        if (!started) {
            if (xQueueReceive(queue, &r, M2T(10)) == pdTRUE) lost = 0;
            continue;
        }
        while (xQueueReceive(queue, &r, 0) == pdTRUE) take_in(&r);
        sense(position, velocity);
        const double place[3] = {position[0], position[1], position[2] - (double)height};
        dtsa_agent_set_state(agent, place, velocity);
        due = dtsa_station_step(station, now_ns(), datagram, &length);
        if (length > 0) {
            lateUs = (uint16_t)((now_ns() - dtsa_station_slot_start(station, status.slot)) / 1000);
            send(datagram, length);
            dtsa_station_sent(station, now_ns(), 1);
        }
        dtsa_station_get_status(station, &status);
        begin_together();
        publish();
        const uint64_t us = usecTimestamp();
        if (us - controlled >= CONTROL_US) {
            steer(position, place, now_ns(), (float)(us - controlled) * 1e-6f);
            controlled = us;
        }
        /* Until something arrives, or a tick is over; what is due within it is waited for awake. */
        if (due - now_ns() > NEAR_US * 1000 && xQueueReceive(queue, &r, M2T(1)) == pdTRUE)
            take_in(&r);
    }
}

PARAM_GROUP_START(dtsa)
PARAM_ADD(PARAM_UINT8, enable, &enable)
PARAM_ADD(PARAM_UINT8, agents, &agents)
PARAM_ADD(PARAM_UINT8, policy, &policy)
PARAM_ADD(PARAM_UINT8, estimator, &estimator)
PARAM_ADD(PARAM_UINT8, mute, &mute) /* for trials: it sends nothing */
PARAM_ADD(PARAM_UINT8, goalsKnown, &goalsKnown)
PARAM_ADD(PARAM_UINT8, port, &p2pPort)
PARAM_ADD(PARAM_UINT16, header, &headerWord)
PARAM_ADD(PARAM_UINT16, steps, &steps)
PARAM_ADD(PARAM_UINT32, slotUs, &slotUs)
PARAM_ADD(PARAM_UINT32, beginSlot, &beginSlot)
PARAM_ADD(PARAM_UINT32, flightUs, &flightUs)
PARAM_ADD(PARAM_UINT32, seed, &seed)
PARAM_ADD(PARAM_FLOAT, height, &height)
PARAM_ADD(PARAM_FLOAT, vMax, &vMax)
PARAM_ADD(PARAM_FLOAT, radius, &pairRadius)
PARAM_ADD(PARAM_FLOAT, horizon, &horizon)
PARAM_ADD(PARAM_FLOAT, newsS, &limits.news_s)
PARAM_ADD(PARAM_FLOAT, restsS, &limits.rests_s)
PARAM_ADD(PARAM_FLOAT, unheardS, &limits.unheard_s)
PARAM_ADD(PARAM_FLOAT, landS, &limits.land_s)
PARAM_ADD(PARAM_FLOAT, batteryV, &limits.battery_v)
PARAM_ADD(PARAM_FLOAT, lowX, &limits.low[0])
PARAM_ADD(PARAM_FLOAT, lowY, &limits.low[1])
PARAM_ADD(PARAM_FLOAT, lowZ, &limits.low[2])
PARAM_ADD(PARAM_FLOAT, highX, &limits.high[0])
PARAM_ADD(PARAM_FLOAT, highY, &limits.high[1])
PARAM_ADD(PARAM_FLOAT, highZ, &limits.high[2])
PARAM_GROUP_STOP(dtsa)

LOG_GROUP_START(dtsa)
LOG_ADD(LOG_UINT32, slot, &slotNow)
LOG_ADD(LOG_UINT8, chosen, &chosen)
LOG_ADD(LOG_UINT8, reason, &reason)
LOG_ADD(LOG_UINT32, digest, &digest)
LOG_ADD(LOG_UINT8, time, &timeState)
LOG_ADD(LOG_UINT8, mode, &mode)
LOG_ADD(LOG_UINT8, why, &why)
LOG_ADD(LOG_FLOAT, oldest, &oldest)
LOG_ADD(LOG_FLOAT, nearest, &nearest)
LOG_ADD(LOG_UINT16, lateUs, &lateUs)
LOG_ADD(LOG_UINT32, sent, &sent)
LOG_ADD(LOG_UINT32, heard, &heard)
LOG_ADD(LOG_UINT32, unsent, &unsent)
LOG_ADD(LOG_UINT32, refused, &refused)
LOG_ADD(LOG_UINT32, lost, &lost)
LOG_GROUP_STOP(dtsa)
