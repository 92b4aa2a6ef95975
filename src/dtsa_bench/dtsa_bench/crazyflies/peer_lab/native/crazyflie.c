// The Crazyflie's functions: radio, set-points, high-level commander, supervisor, battery, log, parameters, app channel.
#include "lab.h"

#include <stdarg.h>
#include <stdio.h>
#include <string.h>

#include "app_channel.h"
#include "cfassert.h"
#include "commander.h"
#include "configblock.h"
#include "crtp_commander_high_level.h"
#include "debug.h"
#include "param.h"
#include "peer_lab.h"
#include "pm.h"
#include "supervisor.h"
#include "system.h"
#include "usec_time.h"

static Vehicle *own(void) { return lab.running ? lab.running->vehicle : lab.loading; }

// ---- radio -----------------------------------------------------------------------------------------------------------

void p2pRegisterCB(P2PCallback callback)
{
    spend(CALL_NS);
    own()->callback = callback;
}

bool radiolinkSendP2PPacketBroadcast(P2PPacket *packet)
{
    spend(CALL_NS);
    Vehicle *vehicle = own();
    if (packet->size > P2P_MAX_DATA_SIZE) misuse("a peer-to-peer packet of more than 60 bytes");
    // The line takes one packet after the other; the caller waits until the last byte has gone.
    int64_t start = vehicle->line_ns > vehicle->free_ns ? vehicle->line_ns : vehicle->free_ns;
    int64_t end = start + lab.line_fixed_ns + lab.line_byte_ns * packet->size;
    vehicle->line_ns = end;
    lab.event.kind = EVENT_SEND;
    lab.event.other_ns = end;
    lab.event.size = packet->size + 1;
    memcpy(lab.event.data, packet->raw, (size_t)packet->size + 1);
    yield_event();
    wait_for(NULL, false, end);
    return true;
}

int configblockGetRadioChannel(void) { return own()->channel; }

int configblockGetRadioSpeed(void) { return own()->speed; }

uint64_t configblockGetRadioAddress(void) { return own()->address; }

// ---- commands to the firmware ------------------------------------------------------------------------------------------

static int command(int code, const void *data, size_t size)
{
    if (!lab.running) return -1;
    lab.event.kind = EVENT_COMMAND;
    lab.event.code = code;
    lab.event.size = (int)size;
    lab.event.answer = 0;
    if (size) memcpy(lab.event.data, data, size);
    yield_event();
    return lab.event.answer;
}

void commanderSetSetpoint(setpoint_t *s, int priority)
{
    spend(CALL_NS);
    s->timestamp = (uint32_t)(local_ns(own(), own()->free_ns) / TICK_NS);
    struct {
        int32_t priority, mode[7], body;
        float position[3], velocity[3], attitude[3], rate[3], thrust;
    } packed = {
        priority,
        {s->mode.x, s->mode.y, s->mode.z, s->mode.roll, s->mode.pitch, s->mode.yaw, s->mode.quat},
        s->velocity_body,
        {s->position.x, s->position.y, s->position.z},
        {s->velocity.x, s->velocity.y, s->velocity.z},
        {s->attitude.roll, s->attitude.pitch, s->attitude.yaw},
        {s->attitudeRate.roll, s->attitudeRate.pitch, s->attitudeRate.yaw},
        s->thrust,
    };
    command(COMMAND_SETPOINT, &packed, sizeof packed);
}

void commanderRelaxPriority(void)
{
    spend(CALL_NS);
    command(COMMAND_RELAX, NULL, 0);
}

static int high_level(int code, const float *values, int count)
{
    spend(CALL_NS);
    return command(code, values, (size_t)count * sizeof *values);
}

int crtpCommanderHighLevelTakeoff(float height_m, float duration_s)
{
    return high_level(COMMAND_TAKEOFF, (float[]){height_m, duration_s, 0, 1}, 4);
}

int crtpCommanderHighLevelTakeoffYaw(float height_m, float duration_s, float yaw)
{
    return high_level(COMMAND_TAKEOFF, (float[]){height_m, duration_s, yaw, 0}, 4);
}

int crtpCommanderHighLevelLand(float height_m, float duration_s)
{
    return high_level(COMMAND_LAND, (float[]){height_m, duration_s, 0, 1}, 4);
}

int crtpCommanderHighLevelLandYaw(float height_m, float duration_s, float yaw)
{
    return high_level(COMMAND_LAND, (float[]){height_m, duration_s, yaw, 0}, 4);
}

int crtpCommanderHighLevelStop(void) { return high_level(COMMAND_STOP, NULL, 0); }

int crtpCommanderHighLevelDisable(void) { return high_level(COMMAND_DISABLE, NULL, 0); }

int crtpCommanderHighLevelGoTo(float x, float y, float z, float yaw, float duration_s,
                               bool relative)
{
    return high_level(COMMAND_GO_TO, (float[]){x, y, z, yaw, duration_s, relative}, 6);
}

bool supervisorRequestArming(bool arm)
{
    spend(CALL_NS);
    return command(COMMAND_ARM, (float[]){arm}, sizeof(float)) != 0;
}

bool supervisorRequestCrashRecovery(bool recover)
{
    spend(CALL_NS);
    return command(COMMAND_RECOVER, (float[]){recover}, sizeof(float)) != 0;
}

// ---- state of the firmware ---------------------------------------------------------------------------------------------

static double firmware_value(const char *name)
{
    spend(CALL_NS);
    for (int i = 0; i < lab.log_name_count; i++)
        if (!strcmp(lab.log_names[i], name)) return own()->log_values[i];
    return 0.0;
}

int commanderGetActivePriority(void) { return (int)firmware_value("lab.priority"); }

enum trajectory_state crtpCommanderHighLevelGetPlannerState(void)
{
    return (enum trajectory_state)firmware_value("lab.planner");
}

// Bits of `supervisor.info`.
uint16_t supervisorGetInfoBitfield(void) { return (uint16_t)firmware_value("supervisor.info"); }

bool supervisorCanArm(void) { return supervisorGetInfoBitfield() & 1; }

bool supervisorIsArmed(void) { return supervisorGetInfoBitfield() & 2; }

bool supervisorCanFly(void) { return supervisorGetInfoBitfield() & 8; }

bool supervisorAreMotorsAllowedToRun(void) { return supervisorCanFly(); }

bool supervisorIsFlying(void) { return supervisorGetInfoBitfield() & 16; }

bool supervisorIsTumbled(void) { return supervisorGetInfoBitfield() & 32; }

bool supervisorIsLocked(void) { return supervisorGetInfoBitfield() & 64; }

bool supervisorIsCrashed(void) { return supervisorGetInfoBitfield() & 128; }

bool crtpCommanderHighLevelIsStopped(void) { return !(supervisorGetInfoBitfield() & 256); }

bool crtpCommanderHighLevelIsTrajectoryFinished(void) { return supervisorGetInfoBitfield() & 512; }

float pmGetBatteryVoltage(void) { return (float)firmware_value("pm.vbat"); }

bool pmIsBatteryLow(void) { return (int)firmware_value("pm.state") == lowPower; }

bool pmIsCharging(void) { return (int)firmware_value("pm.state") == charging; }

bool pmIsDischarging(void) { return (int)firmware_value("pm.state") == battery; }

void systemWaitStart(void) { spend(CALL_NS); }

// ---- log variables and parameters ------------------------------------------------------------------------------------

void labRegister(int parameters, const char *group, const struct labVariable *variables, int count)
{
    Vehicle *vehicle = lab.loading;
    if (!vehicle) return;
    int *used = parameters ? &vehicle->parameter_count : &vehicle->log_count;
    Variable *table = parameters ? vehicle->parameters : vehicle->logs;
    for (int i = 0; i < count && *used >= 0; i++) {
        if (*used == MAX_VARIABLES) {
            *used = -1;
            return;
        }
        Variable *variable = &table[(*used)++];
        variable->type = variables[i].type;
        variable->address = variables[i].address;
        variable->callback = variables[i].callback;
        snprintf(variable->name, sizeof variable->name, "%.30s.%.30s", group, variables[i].name);
    }
}

static int find(const Variable *table, int count, const char *name)
{
    for (int i = 0; i < count; i++)
        if (!strcmp(table[i].name, name)) return i;
    return -1;
}

static double by_function(const Variable *variable)
{
    const logByFunction_t *source = variable->address;
    switch (variable->type & 15) {
    case LOG_UINT8:
        return source->acquireUInt8(0, source->data);
    case LOG_UINT16:
        return source->acquireUInt16(0, source->data);
    case LOG_UINT32:
        return source->acquireUInt32(0, source->data);
    case LOG_INT8:
        return source->acquireInt8(0, source->data);
    case LOG_INT16:
        return source->acquireInt16(0, source->data);
    case LOG_INT32:
        return source->acquireInt32(0, source->data);
    default:
        return source->aquireFloat(0, source->data);
    }
}

// Types of log variables and of parameters have numbers of their own.
static int log_type(const Variable *variable)
{
    static const int of_parameter[16] = {
        [PARAM_UINT8] = LOG_UINT8, [PARAM_UINT16] = LOG_UINT16, [PARAM_UINT32] = LOG_UINT32,
        [PARAM_INT8] = LOG_INT8,   [PARAM_INT16] = LOG_INT16,   [PARAM_INT32] = LOG_INT32,
        [PARAM_FLOAT] = LOG_FLOAT,
    };
    return of_parameter[variable->type & 15];
}

static double value_of(const void *address, int type)
{
    switch (type) {
    case LOG_UINT8:
        return *(const uint8_t *)address;
    case LOG_UINT16:
        return *(const uint16_t *)address;
    case LOG_UINT32:
        return *(const uint32_t *)address;
    case LOG_INT8:
        return *(const int8_t *)address;
    case LOG_INT16:
        return *(const int16_t *)address;
    case LOG_INT32:
        return *(const int32_t *)address;
    default:
        return *(const float *)address;
    }
}

double variable_value(const Variable *variable)
{
    bool parameter = false;
    for (int k = 0; k < lab.count && !parameter; k++)
        parameter = variable >= lab.vehicles[k].parameters &&
                    variable < lab.vehicles[k].parameters + MAX_VARIABLES;
    if (parameter) return value_of(variable->address, log_type(variable));
    if (variable->type & LOG_TYPE_BY_FUNCTION) return by_function(variable);
    return value_of(variable->address, variable->type & 15);
}

void set_variable(Vehicle *vehicle, Variable *variable, double value)
{
    switch (log_type(variable)) {
    case LOG_UINT8:
        *(uint8_t *)variable->address = (uint8_t)value;
        break;
    case LOG_UINT16:
        *(uint16_t *)variable->address = (uint16_t)value;
        break;
    case LOG_UINT32:
        *(uint32_t *)variable->address = (uint32_t)value;
        break;
    case LOG_INT8:
        *(int8_t *)variable->address = (int8_t)value;
        break;
    case LOG_INT16:
        *(int16_t *)variable->address = (int16_t)value;
        break;
    case LOG_INT32:
        *(int32_t *)variable->address = (int32_t)value;
        break;
    default:
        *(float *)variable->address = (float)value;
        break;
    }
    Job job = {.callback = variable->callback};
    if (job.callback) push_item(vehicle, &vehicle->parameter_jobs, &job, false);
}

logVarId_t logGetVarId(const char *group, const char *name)
{
    char full[64];
    snprintf(full, sizeof full, "%.30s.%.30s", group, name);
    spend(CALL_NS);
    for (int i = 0; i < lab.log_name_count; i++)
        if (!strcmp(lab.log_names[i], full)) return (logVarId_t)i;
    int own_id = find(own()->logs, own()->log_count, full);
    return own_id < 0 ? 0xffff : (logVarId_t)(lab.log_name_count + own_id);
}

static double logged(logVarId_t id)
{
    spend(CALL_NS);
    if (id < lab.log_name_count) return own()->log_values[id];
    if (id < lab.log_name_count + own()->log_count)
        return variable_value(&own()->logs[id - lab.log_name_count]);
    misuse("a log variable that does not exist");
}

float logGetFloat(logVarId_t id) { return (float)logged(id); }

int logGetInt(logVarId_t id) { return (int)logged(id); }

unsigned int logGetUint(logVarId_t id) { return (unsigned int)(int64_t)logged(id); }

paramVarId_t paramGetVarIdFromComplete(const char *name)
{
    spend(CALL_NS);
    int id = find(own()->parameters, own()->parameter_count, name);
    for (int i = 0; id < 0 && i < lab.parameter_name_count; i++)
        if (!strcmp(lab.parameter_names[i], name)) id = MAX_VARIABLES + i; // the firmware's own
    return (paramVarId_t){id < 0 ? 0xffff : (uint16_t)id, id < 0 ? 0xffff : (uint16_t)id};
}

paramVarId_t paramGetVarId(const char *group, const char *name)
{
    char full[64];
    snprintf(full, sizeof full, "%.30s.%.30s", group, name);
    return paramGetVarIdFromComplete(full);
}

static bool is_own(paramVarId_t id)
{
    spend(CALL_NS);
    if (id.id >= MAX_VARIABLES && id.id < MAX_VARIABLES + lab.parameter_name_count) return false;
    if (id.id >= own()->parameter_count) misuse("a parameter that does not exist");
    return true;
}

static double parameter(paramVarId_t id)
{
    if (is_own(id)) return variable_value(&own()->parameters[id.id]);
    return own()->parameter_values[id.id - MAX_VARIABLES];
}

static void set_parameter(paramVarId_t id, double value)
{
    if (is_own(id)) {
        set_variable(own(), &own()->parameters[id.id], value);
        return;
    }
    float packed[2] = {(float)(id.id - MAX_VARIABLES), (float)value};
    command(COMMAND_PARAMETER, packed, sizeof packed);
}

float paramGetFloat(paramVarId_t id) { return (float)parameter(id); }

int paramGetInt(paramVarId_t id) { return (int)parameter(id); }

unsigned int paramGetUint(paramVarId_t id) { return (unsigned int)parameter(id); }

void paramSetInt(paramVarId_t id, int value) { set_parameter(id, value); }

void paramSetFloat(paramVarId_t id, float value) { set_parameter(id, (double)value); }

// ---- app channel, console, assertions --------------------------------------------------------------------------------

int appchannelSendDataPacket(void *data, size_t length)
{
    spend(CALL_NS);
    lab.event.kind = EVENT_APP_CHANNEL;
    lab.event.size = (int)(length > APPCHANNEL_MTU ? APPCHANNEL_MTU : length);
    memcpy(lab.event.data, data, (size_t)lab.event.size);
    yield_event();
    return 1;
}

void appchannelSendDataPacketBlock(void *data, size_t length)
{
    (void)appchannelSendDataPacket(data, length);
}

size_t appchannelReceiveDataPacket(void *buffer, size_t max_length, int timeout_ms)
{
    uint8_t item[32];
    TickType_t ticks = timeout_ms < 0 ? portMAX_DELAY : (TickType_t)timeout_ms;
    if (xQueueReceive(&own()->app_channel, item, ticks) != pdTRUE) return 0;
    size_t length = item[0] < max_length ? item[0] : max_length;
    memcpy(buffer, item + 1, length);
    return length;
}

bool appchannelHasOverflowOccurred(void)
{
    spend(CALL_NS);
    bool overflow = own()->app_overflow;
    own()->app_overflow = false;
    return overflow;
}

bool appchannelHasOverflowOccured(void) { return appchannelHasOverflowOccurred(); }

void peerLabRecord(const void *data, uint32_t size)
{
    if (!lab.running) return;
    if (size > EVENT_BYTES) misuse("peerLabRecord with more than 1024 bytes");
    lab.calls++;
    lab.event.kind = EVENT_RECORD;
    lab.event.size = (int)size;
    memcpy(lab.event.data, data, size);
    yield_event();
}

void labPrint(const char *format, ...)
{
    // On the Cortex-M4 a long has 32 bits: `%lu` is read as `%u`.
    char narrow[256];
    size_t used = 0;
    for (const char *c = format; *c && used + 1 < sizeof narrow; c++) {
        narrow[used++] = *c;
        if (*c != '%') continue;
        while (c[1] && strchr("-+ #0123456789.*", c[1]) && used + 1 < sizeof narrow)
            narrow[used++] = *++c;
        if (c[1] == 'l' && c[2] != 'l' && c[2] && strchr("diuxXo", c[2]))
            c++;
        else if (c[1] == '%' && used + 1 < sizeof narrow)
            narrow[used++] = *++c;
    }
    narrow[used] = 0;
    char text[256];
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(text, sizeof text, narrow, arguments);
    va_end(arguments);
    spend(CALL_NS);
    if (!lab.running) return;
    lab.event.kind = EVENT_PRINT;
    lab.event.size = (int)strlen(text);
    memcpy(lab.event.data, text, (size_t)lab.event.size);
    yield_event();
}

void labAssertFailed(const char *file, int line)
{
    for (;;) {
        const char *name = strrchr(file, '/');
        lab.event.size = snprintf((char *)lab.event.data, sizeof lab.event.data, "%s:%d",
                                  name ? name + 1 : file, line);
        lab.event.kind = EVENT_ASSERT;
        yield_event();
    }
}
