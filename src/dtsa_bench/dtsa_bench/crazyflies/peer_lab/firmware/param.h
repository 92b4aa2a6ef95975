// Own declarations of functions that the documentation of the Crazyflie firmware names: apps are compiled against them
// for this machine. No text of the firmware is in here.
#pragma once

#include "log.h"

typedef struct paramVarId_s {
    uint16_t id;
    uint16_t index;
} __attribute__((packed)) paramVarId_t;

#define PARAM_UINT8 0x08
#define PARAM_UINT16 0x09
#define PARAM_UINT32 0x0A
#define PARAM_INT8 0x00
#define PARAM_INT16 0x01
#define PARAM_INT32 0x02
#define PARAM_FLOAT 0x06
#define PARAM_CORE 0x20
#define PARAM_RONLY 0x40
#define PARAM_PERSISTENT 0x100
#define PARAM_VARID_IS_VALID(ID) ((ID).id != 0xffffu)

paramVarId_t paramGetVarId(const char *group, const char *name);
paramVarId_t paramGetVarIdFromComplete(const char *name);
float paramGetFloat(paramVarId_t id);
int paramGetInt(paramVarId_t id);
unsigned int paramGetUint(paramVarId_t id);
void paramSetInt(paramVarId_t id, int value);
void paramSetFloat(paramVarId_t id, float value);

#define PARAM_GROUP_START(NAME) LAB_GROUP_START(Param, NAME)
#define PARAM_ADD_WITH_CALLBACK(TYPE, NAME, ADDRESS, CALLBACK)                                     \
    {TYPE, #NAME, (void *)(ADDRESS), (void (*)(void))(CALLBACK)},
#define PARAM_ADD(TYPE, NAME, ADDRESS) PARAM_ADD_WITH_CALLBACK(TYPE, NAME, ADDRESS, 0)
#define PARAM_ADD_CORE(TYPE, NAME, ADDRESS) PARAM_ADD(TYPE, NAME, ADDRESS)
#define PARAM_ADD_CORE_WITH_CALLBACK(TYPE, NAME, ADDRESS, CALLBACK)                                \
    PARAM_ADD_WITH_CALLBACK(TYPE, NAME, ADDRESS, CALLBACK)
#define PARAM_GROUP_STOP(NAME) LAB_GROUP_STOP(Param, NAME, 1)
