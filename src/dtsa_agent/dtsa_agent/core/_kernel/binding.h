/* Python's door to libdtsa: values and arrays of Python into structures of C by tables (fields.c), functions with their
 * arguments by tables (call.c). Arrays come in through the buffer protocol and are borrowed, not copied, so that Python and
 * C look at the same memory; core/swarm.py and dtsa_bench/metrics.py make and document them. */
#ifndef DTSA_BINDING_H
#define DTSA_BINDING_H

#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include "avoider/avoider.h"
#include "metrics.h"
#include "swarm.h"

/* ---- structures ---- */

enum { ARRAYS_MAX = 40 };

/* A scalar ('i' int, 'q' int64, 'd' double), or an array of items of `size` bytes. */
typedef struct field {
    const char *name;
    size_t offset;
    char kind;   /* of arrays: what decides about their length */
    size_t size; /* 0: a scalar */
} field;

/* A structure that lives as long as a capsule, with the arrays that it borrows. */
typedef struct holder {
    union {
        swarm s;
        metrics m;
    } of;
    Py_buffer arrays[ARRAYS_MAX];
    int count;
} holder;

extern const field AVOID_FIELDS[];
int fill_scalars(void *object, const field *fields, PyObject *values); /* -1: exception set */
PyObject *make_swarm(PyObject *values, PyObject *arrays);
PyObject *make_metrics(PyObject *values, PyObject *arrays);

/* ---- calls ---- */

enum { ARGS_MAX = 10 };

/* One argument: 'q' whole number, 'd' number, 'P' parameters of avoiders, 'O' object, 'S' swarm, 'M' metrics, or an array
 * of fixed + times * n items of `size` bytes (0: of any length): 'r' to read, 'w' to write, 'h' whole numbers to read.
 * none: it may be None. n follows from the first array that has it. */
typedef struct arg {
    const char *name;
    char kind;
    uint8_t size, times, fixed, none;
} arg;

typedef struct call {
    Py_ssize_t given; /* arguments */
    Py_ssize_t n;
    void *at[ARGS_MAX]; /* NULL: None, or not given */
    Py_ssize_t items[ARGS_MAX];
    int64_t whole[ARGS_MAX];
    double real[ARGS_MAX];
    dtsa_avoid_params params;
    Py_buffer buffers[ARGS_MAX];
    int borrowed;
} call;

typedef struct function {
    const char *name;
    PyObject *(*run)(const call *c);
    int least; /* arguments that must be given */
    arg args[ARGS_MAX + 1];
} function;

int add_functions(PyObject *module, const function *functions); /* up to one without a name */

#endif
