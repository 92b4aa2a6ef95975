/* Shared between the binding's files. */
#ifndef DTSA_MODULE_AVOIDER_H
#define DTSA_MODULE_AVOIDER_H

#include <Python.h>

#include "avoider.h"

/* Reads every field of avoid_params from a dict by name; on failure sets an exception and returns -1. */
int avoid_params_from_dict(PyObject *dict, avoid_params *params);

#endif
