/* Shared between the files of the binding. */
#ifndef DTSA_MODULE_H
#define DTSA_MODULE_H

#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include "dtsa.h"

enum { ARRAY_COUNT = 34 };

typedef struct {
    PyObject_HEAD swarm s;
    Py_buffer arrays[ARRAY_COUNT];
    int borrowed;
} SwarmObject;

enum { METRICS_CRASHED = 1, METRICS_ARRIVED = 2 };

extern PyTypeObject SwarmType, MetricsType;
extern PyMethodDef avoider_methods[], lease_methods[];

/* Metres of one step of a coordinate; on failure sets an exception and returns -1. */
int step_arg(PyObject *object, double *step);
/* names.c: tuples of names by kind of list; on failure sets an exception and returns NULL. */
PyObject *names_dict(void);

/* A C-contiguous buffer of exactly `count` items of `itemsize` bytes; on failure sets an exception and returns -1. */
int borrow(PyObject *object, const char *name, Py_ssize_t count, Py_ssize_t itemsize, int writable,
           Py_buffer *out);
/* A slot's number; on failure sets an exception and returns -1. */
int slot_arg(PyObject *object, int64_t *slot);

#endif
