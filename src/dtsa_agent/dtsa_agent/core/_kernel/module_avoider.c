/* Python's door to avoiders and vehicles alone (tests, benchmarks, the Crazyflie bridge). Arrays are buffers of float64. */
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <stddef.h>

#include "avoider.h"
#include "module_avoider.h"
#include "vehicle.h"

extern PyMethodDef avoider_methods[];

static const struct {
    const char *name;
    size_t offset;
} PARAM_FIELDS[] = {
#define PARAM(field) {#field, offsetof(avoid_params, field)}
    PARAM(v_max),      PARAM(gain),        PARAM(radius),     PARAM(horizon),  PARAM(softness),
    PARAM(bias),       PARAM(period),      PARAM(influence),  PARAM(strength), PARAM(core),
    PARAM(tangential), PARAM(margin_rate), PARAM(margin_max), PARAM(sidestep), PARAM(stretch_z),
#undef PARAM
};

int avoid_params_from_dict(PyObject *dict, avoid_params *params)
{
    if (!PyDict_Check(dict)) {
        PyErr_SetString(PyExc_TypeError, "avoider parameters must be a dict");
        return -1;
    }
    for (size_t i = 0; i < sizeof PARAM_FIELDS / sizeof *PARAM_FIELDS; i++) {
        PyObject *item = PyDict_GetItemString(dict, PARAM_FIELDS[i].name);
        if (!item) {
            PyErr_Format(PyExc_KeyError, "avoider parameter %s is missing", PARAM_FIELDS[i].name);
            return -1;
        }
        const double value = PyFloat_AsDouble(item);
        if (value == -1.0 && PyErr_Occurred()) return -1;
        *(double *)((char *)params + PARAM_FIELDS[i].offset) = value;
    }
    return 0;
}

/* The buffers of one call; all are released together. */
typedef struct {
    Py_buffer tables[8];
    int count;
} borrowed;

static void give_back(borrowed *b)
{
    while (b->count > 0) PyBuffer_Release(&b->tables[--b->count]);
}

/* count: number of doubles wanted, or -1 for any whole multiple of 3. */
static Py_buffer *take(borrowed *b, PyObject *object, const char *name, Py_ssize_t count,
                       int writable)
{
    Py_buffer *table = &b->tables[b->count];
    const int flags = PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | (writable ? PyBUF_WRITABLE : 0);
    if (PyObject_GetBuffer(object, table, flags) < 0) return NULL;
    b->count++;
    const Py_ssize_t items = table->len / (Py_ssize_t)sizeof(double);
    if (table->itemsize != sizeof(double) || !table->format || table->format[0] != 'd' ||
        table->format[1]) {
        PyErr_Format(PyExc_ValueError, "%s: items must be float64", name);
        return NULL;
    }
    if (count < 0 ? items % 3 != 0 || items > 3 * 65536 : items != count) {
        PyErr_Format(PyExc_ValueError, "%s: wrong number of values: %zd", name, items);
        return NULL;
    }
    return table;
}

static int check_kind(int kind)
{
    if (kind >= 0 && kind < AVOID_KINDS) return 0;
    PyErr_Format(PyExc_ValueError, "kind: no avoider has the number %d", kind);
    return -1;
}

static PyObject *py_avoid_command(PyObject *module, PyObject *args)
{
    (void)module;
    int kind, self;
    PyObject *dict, *position, *velocity, *goal, *others_p, *others_v, *age, *command;
    if (!PyArg_ParseTuple(args, "iOiOOOOOOO", &kind, &dict, &self, &position, &velocity, &goal,
                          &others_p, &others_v, &age, &command))
        return NULL;
    avoid_params params;
    if (check_kind(kind) < 0 || avoid_params_from_dict(dict, &params) < 0) return NULL;
    borrowed b = {.count = 0};
    Py_buffer *p = NULL, *v = NULL, *g = NULL, *op = NULL, *ov = NULL, *a = NULL, *c = NULL;
    double *scratch = NULL;
    int ok = (p = take(&b, position, "position", 3, 0)) &&
             (v = take(&b, velocity, "velocity", 3, 0)) && (g = take(&b, goal, "goal", 3, 0)) &&
             (op = take(&b, others_p, "others_p", -1, 0)) &&
             (ov = take(&b, others_v, "others_v", op->len / (Py_ssize_t)sizeof(double), 0)) &&
             (c = take(&b, command, "command", 3, 1));
    const int n = ok ? (int)(op->len / (Py_ssize_t)(3 * sizeof(double))) : 0;
    if (ok && age != Py_None) ok = (a = take(&b, age, "age_s", n, 0)) != NULL;
    if (ok && !(scratch = PyMem_Malloc(sizeof(double) * (size_t)avoid_scratch_doubles(n)))) {
        PyErr_NoMemory();
        ok = 0;
    }
    if (ok)
        avoid_command(kind, &params, n, self, p->buf, v->buf, g->buf, op->buf, ov->buf,
                      a ? a->buf : NULL, scratch, c->buf);
    PyMem_Free(scratch);
    give_back(&b);
    if (!ok) return NULL;
    Py_RETURN_NONE;
}

/* All agents of a swarm at once, each with its own true state and one common table of beliefs. */
static PyObject *py_avoid_all(PyObject *module, PyObject *args)
{
    (void)module;
    int kind;
    PyObject *dict, *position, *velocity, *goal, *others_p, *others_v, *age, *command;
    if (!PyArg_ParseTuple(args, "iOOOOOOOO", &kind, &dict, &position, &velocity, &goal, &others_p,
                          &others_v, &age, &command))
        return NULL;
    avoid_params params;
    if (check_kind(kind) < 0 || avoid_params_from_dict(dict, &params) < 0) return NULL;
    borrowed b = {.count = 0};
    Py_buffer *p = take(&b, position, "position", -1, 0);
    const Py_ssize_t items = p ? p->len / (Py_ssize_t)sizeof(double) : 0;
    const int n = (int)(items / 3);
    Py_buffer *v = NULL, *g = NULL, *op = NULL, *ov = NULL, *a = NULL, *c = NULL;
    double *scratch = NULL;
    int ok = p && (v = take(&b, velocity, "velocity", items, 0)) &&
             (g = take(&b, goal, "goal", items, 0)) &&
             (op = take(&b, others_p, "others_p", items, 0)) &&
             (ov = take(&b, others_v, "others_v", items, 0)) &&
             (c = take(&b, command, "command", items, 1));
    if (ok && age != Py_None) ok = (a = take(&b, age, "age_s", n, 0)) != NULL;
    if (ok && !(scratch = PyMem_Malloc(sizeof(double) * (size_t)avoid_scratch_doubles(n)))) {
        PyErr_NoMemory();
        ok = 0;
    }
    for (int i = 0; ok && i < n; i++) {
        double own[3][3], out[3];
        for (int axis = 0; axis < 3; axis++) {
            own[0][axis] = ((const double *)p->buf)[axis * n + i];
            own[1][axis] = ((const double *)v->buf)[axis * n + i];
            own[2][axis] = ((const double *)g->buf)[axis * n + i];
        }
        avoid_command(kind, &params, n, i, own[0], own[1], own[2], op->buf, ov->buf,
                      a ? a->buf : NULL, scratch, out);
        for (int axis = 0; axis < 3; axis++) ((double *)c->buf)[axis * n + i] = out[axis];
    }
    PyMem_Free(scratch);
    give_back(&b);
    if (!ok) return NULL;
    Py_RETURN_NONE;
}

static PyObject *py_vehicle_step(PyObject *module, PyObject *args)
{
    (void)module;
    vehicle_params params;
    double dt;
    PyObject *position, *velocity, *command;
    if (!PyArg_ParseTuple(args, "dddOOO", &params.tau, &params.a_max, &dt, &position, &velocity,
                          &command))
        return NULL;
    borrowed b = {.count = 0};
    Py_buffer *p = take(&b, position, "position", -1, 1), *v = NULL, *c = NULL;
    const Py_ssize_t items = p ? p->len / (Py_ssize_t)sizeof(double) : 0;
    const int ok = p && (v = take(&b, velocity, "velocity", items, 1)) &&
                   (c = take(&b, command, "command", items, 0));
    if (ok) vehicle_step_all(&params, dt, (int)(items / 3), p->buf, v->buf, c->buf);
    give_back(&b);
    if (!ok) return NULL;
    Py_RETURN_NONE;
}

static PyObject *py_vector_level(PyObject *module, PyObject *args)
{
    (void)module;
    int level = -1;
    if (!PyArg_ParseTuple(args, "|i", &level)) return NULL;
    return PyLong_FromLong(avoid_vector_level(level));
}

PyMethodDef avoider_methods[] = {
    {"avoid_command", py_avoid_command, METH_VARARGS,
     "avoid_command(kind, params, self_index, position, velocity, goal, others_p, others_v, age_s, "
     "command)\n\n"
     "Commanded velocity of one agent, written into command (3,), m/s. position, velocity, goal: "
     "(3,); others_p,\n"
     "others_v: (3, N) what it believes about all; age_s: (N,) s or None. All float64, SI units, "
     "frame map."},
    {"avoid_all", py_avoid_all, METH_VARARGS,
     "avoid_all(kind, params, position, velocity, goal, others_p, others_v, age_s, command)\n\n"
     "The same for all N agents with one common table of beliefs; arrays (3, N), age_s (N,) or "
     "None."},
    {"vehicle_step", py_vehicle_step, METH_VARARGS,
     "vehicle_step(tau, a_max, dt, position, velocity, command)\n\n"
     "Moves vehicles by dt s; position and velocity, (3,) or (3, N) float64, are updated in "
     "place."},
    {"vector_level", py_vector_level, METH_VARARGS,
     "vector_level([level]) -> int\n\n"
     "Instructions in use: 0 baseline, 1 AVX2; same bits either way. A level sets it (bounded by "
     "the machine)."},
    {NULL, NULL, 0, NULL},
};
