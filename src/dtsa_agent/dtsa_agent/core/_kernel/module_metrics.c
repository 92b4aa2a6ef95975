/* Python's door to the sums over one flight: kernel type Metrics. dtsa_bench/metrics.py uses it. */
#include "module.h"

#include <string.h>

typedef struct {
    PyObject_HEAD metrics m;
    int n;
    int64_t news_from;
    double collision_m, r_min;
    uint8_t *moving;
    double *target;
} MetricsObject;

static int metrics_init(MetricsObject *self, PyObject *args, PyObject *kwargs)
{
    static char *names[] = {"start", "target", "moving", "news_from", "collision_m", "r_min", NULL};
    PyObject *start, *target, *moving;
    long long from = 0;
    if (!PyArg_ParseTupleAndKeywords(args, kwargs, "OOOLdd", names, &start, &target, &moving, &from,
                                     &self->collision_m, &self->r_min))
        return -1;
    Py_buffer table;
    if (self->moving) {
        PyErr_SetString(PyExc_RuntimeError, "metrics are created once");
        return -1;
    }
    if (PyObject_GetBuffer(moving, &table, PyBUF_C_CONTIGUOUS) < 0) return -1;
    const int n = (int)table.len;
    self->n = n;
    self->news_from = from;
    self->moving = PyMem_Malloc((size_t)n + 1);
    self->m.path = PyMem_Calloc((size_t)n + 1, sizeof(double));
    self->m.last_position = PyMem_Calloc((size_t)(3 * n) + 1, sizeof(double));
    self->target = PyMem_Calloc((size_t)(3 * n) + 1, sizeof(double));
    if (self->moving) memcpy(self->moving, table.buf, (size_t)n);
    PyBuffer_Release(&table);
    if (!self->moving || !self->m.path || !self->m.last_position || !self->target) {
        PyErr_NoMemory();
        return -1;
    }
    if (borrow(start, "start", 3 * n, 8, 0, &table) < 0) return -1;
    memcpy(self->m.last_position, table.buf, sizeof(double) * 3 * (size_t)n);
    PyBuffer_Release(&table);
    if (borrow(target, "target", 3 * n, 8, 0, &table) < 0) return -1;
    memcpy(self->target, table.buf, sizeof(double) * 3 * (size_t)n);
    PyBuffer_Release(&table);
    self->m.min_distance2 = 1e300;
    return 0;
}

static void metrics_dealloc(MetricsObject *self)
{
    PyMem_Free(self->moving);
    PyMem_Free(self->target);
    PyMem_Free(self->m.path);
    PyMem_Free(self->m.last_position);
    Py_TYPE(self)->tp_free((PyObject *)self);
}

static PyObject *metrics_update(MetricsObject *self, PyObject *const *args, Py_ssize_t count)
{
    int64_t slot;
    if (count != 3) return PyErr_Format(PyExc_TypeError, "update(slot, track, tables)");
    if (slot_arg(args[0], &slot) < 0) return NULL;
    Py_buffer track;
    if (PyObject_GetBuffer(args[1], &track, PyBUF_C_CONTIGUOUS) < 0) return NULL;
    const Py_ssize_t plane = (Py_ssize_t)sizeof(double) * 3 * self->n;
    if (track.len < plane || track.len % plane) {
        PyBuffer_Release(&track);
        return PyErr_Format(PyExc_ValueError, "track: allowed: shape (steps, 3, %d)", self->n);
    }
    const int steps = (int)(track.len / plane);
    const double *now = (const double *)track.buf + (long)(steps - 1) * 3 * self->n;
    int state = metrics_distance(&self->m, self->n, steps, slot, track.buf, self->collision_m)
                    ? METRICS_CRASHED
                    : 0;
    if (metrics_arrived(self->n, now, self->target, self->moving, self->r_min))
        state |= METRICS_ARRIVED;
    if (args[2] != Py_None && slot >= self->news_from) {
        if (!PyObject_TypeCheck(args[2], &SwarmType) || ((SwarmObject *)args[2])->s.n != self->n) {
            PyBuffer_Release(&track);
            return PyErr_Format(PyExc_TypeError, "tables: allowed: a Swarm of %d agents, or None",
                                self->n);
        }
        metrics_news(&self->m, &((SwarmObject *)args[2])->s, slot, now, self->moving);
    }
    PyBuffer_Release(&track);
    return PyLong_FromLong(state);
}

static PyObject *metrics_result(MetricsObject *self, PyObject *unused)
{
    (void)unused;
    const metrics *m = &self->m;
    PyObject *path = PyList_New(self->n);
    if (!path) return NULL;
    for (int k = 0; k < self->n; k++) PyList_SET_ITEM(path, k, PyFloat_FromDouble(m->path[k]));
    return Py_BuildValue("{s:d,s:(ii),s:L,s:N,s:L,s:L,s:L,s:d,s:d}", "min_distance2",
                         m->min_distance2, "pair", m->pair[0], m->pair[1], "min_slot",
                         (long long)m->min_slot, "path", path, "age_count", (long long)m->age_count,
                         "age_sum", (long long)m->age_sum, "age_max", (long long)m->age_max,
                         "error_sum", m->error_sum, "error_max", m->error_max);
}

static PyObject *metrics_drop(MetricsObject *self, PyObject *arg)
{
    const long k = PyLong_AsLong(arg);
    if (k == -1 && PyErr_Occurred()) return NULL;
    if (k < 0 || k >= self->n) return PyErr_Format(PyExc_IndexError, "no agent %ld", k);
    self->moving[k] = 0;
    Py_RETURN_NONE;
}

static PyMethodDef METRICS_METHODS[] = {
    {"update", (PyCFunction)(void (*)(void))metrics_update, METH_FASTCALL,
     "update(slot, track, tables) -> METRICS_CRASHED, METRICS_ARRIVED or both"},
    {"drop", (PyCFunction)metrics_drop, METH_O, "drop(index): a mover that is lost counts no more"},
    {"result", (PyCFunction)metrics_result, METH_NOARGS, "result() -> the sums so far"},
    {NULL, NULL, 0, NULL},
};

PyTypeObject MetricsType = {
    PyVarObject_HEAD_INIT(NULL, 0).tp_name = "dtsa_agent.core._kernel.Metrics",
    .tp_basicsize = sizeof(MetricsObject),
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_doc =
        "Metrics(start, target, moving, news_from, collision_m, r_min): sums over one flight.",
    .tp_new = PyType_GenericNew,
    .tp_init = (initproc)metrics_init,
    .tp_dealloc = (destructor)metrics_dealloc,
    .tp_methods = METRICS_METHODS,
};
