// Own declarations of functions that the documentation of the Crazyflie firmware names: apps are compiled against them
// for this machine. No text of the firmware is in here.
#pragma once

#include <stdbool.h>
#include <stdint.h>

typedef uint16_t logVarId_t;

#define LOG_UINT8 1
#define LOG_UINT16 2
#define LOG_UINT32 3
#define LOG_INT8 4
#define LOG_INT16 5
#define LOG_INT32 6
#define LOG_FLOAT 7
#define LOG_FP16 8
#define LOG_TYPE_BY_FUNCTION 0x40

static inline bool logVarIdIsValid(logVarId_t id) { return id != 0xffffu; }

logVarId_t logGetVarId(const char *group, const char *name);
float logGetFloat(logVarId_t id);
int logGetInt(logVarId_t id);
unsigned int logGetUint(logVarId_t id);

typedef uint8_t (*logAcquireUInt8)(uint32_t timestamp, void *data);
typedef uint16_t (*logAcquireUInt16)(uint32_t timestamp, void *data);
typedef uint32_t (*logAcquireUInt32)(uint32_t timestamp, void *data);
typedef int8_t (*logAcquireInt8)(uint32_t timestamp, void *data);
typedef int16_t (*logAcquireInt16)(uint32_t timestamp, void *data);
typedef int32_t (*logAcquireInt32)(uint32_t timestamp, void *data);
typedef float (*logAcquireFloat)(uint32_t timestamp, void *data);

// A value that a function gives when it is asked for.
typedef struct {
    union {
        logAcquireUInt8 acquireUInt8;
        logAcquireUInt16 acquireUInt16;
        logAcquireUInt32 acquireUInt32;
        logAcquireInt8 acquireInt8;
        logAcquireInt16 acquireInt16;
        logAcquireInt32 acquireInt32;
        logAcquireFloat aquireFloat;
    };
    void *data;
} logByFunction_t;

// A group of variables registers itself when the app is loaded.
struct labVariable {
    int type;
    const char *name;
    void *address;
    void (*callback)(void);
};
void labRegister(int parameters, const char *group, const struct labVariable *variables, int count);

#define LAB_GROUP_START(KIND, NAME)                                                                \
    static const char lab##KIND##Name_##NAME[] = #NAME;                                            \
    static const struct labVariable lab##KIND##_##NAME[] = {
#define LAB_GROUP_STOP(KIND, NAME, PARAMETERS)                                                     \
    {0, 0, 0, 0}                                                                                   \
    }                                                                                              \
    ;                                                                                              \
    __attribute__((constructor)) static void labRegister##KIND##_##NAME(void)                      \
    {                                                                                              \
        labRegister(PARAMETERS, lab##KIND##Name_##NAME, lab##KIND##_##NAME,                        \
                    (int)(sizeof(lab##KIND##_##NAME) / sizeof(lab##KIND##_##NAME[0])) - 1);        \
    }

#define LOG_GROUP_START(NAME) LAB_GROUP_START(Log, NAME)
#define LOG_ADD(TYPE, NAME, ADDRESS) {TYPE, #NAME, (void *)(ADDRESS), 0},
#define LOG_ADD_CORE(TYPE, NAME, ADDRESS) LOG_ADD(TYPE, NAME, ADDRESS)
#define LOG_ADD_DEBUG(TYPE, NAME, ADDRESS) LOG_ADD(TYPE, NAME, ADDRESS)
#define LOG_ADD_BY_FUNCTION(TYPE, NAME, ADDRESS)                                                   \
    LOG_ADD((TYPE) | LOG_TYPE_BY_FUNCTION, NAME, ADDRESS)
#define LOG_GROUP_STOP(NAME) LAB_GROUP_STOP(Log, NAME, 0)
