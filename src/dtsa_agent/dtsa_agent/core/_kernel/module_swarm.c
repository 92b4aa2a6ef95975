/* Python's door to agents in slots: kernel type Swarm. core/swarm.py makes and documents its arrays. */
#include "module.h"

#include <stddef.h>

#include "lease.h"
#include "module_avoider.h"

static int64_t number_or(PyObject *dict, const char *name, int *failed)
{
    PyObject *item = PyDict_GetItemString(dict, name);
    if (!item) {
        PyErr_Format(PyExc_KeyError, "parameter %s is missing", name);
        *failed = 1;
        return 0;
    }
    const long long value = PyLong_AsLongLong(item);
    if (value == -1 && PyErr_Occurred()) *failed = 1;
    return value;
}

static double real_or(PyObject *dict, const char *name, int *failed)
{
    PyObject *item = PyDict_GetItemString(dict, name);
    if (!item) {
        PyErr_Format(PyExc_KeyError, "parameter %s is missing", name);
        *failed = 1;
        return 0.0;
    }
    const double value = PyFloat_AsDouble(item);
    if (value == -1.0 && PyErr_Occurred()) *failed = 1;
    return value;
}

typedef struct {
    const char *name;
    size_t offset;
    Py_ssize_t itemsize;
    char shape; /* what the count is made of, see array_count */
} array_spec;

#define FIELD(name, size, shape) {#name, offsetof(swarm, name), size, shape}
static const array_spec ARRAYS[] = {
    FIELD(local, 4, 'l'),  FIELD(observer, 4, 'v'),   FIELD(start, 8, 'N'),
    FIELD(target, 8, 'N'), FIELD(sent_p, 8, 'T'),     FIELD(sent_v, 8, 'T'),
    FIELD(sent_c, 8, 'T'), FIELD(sent_slot, 8, 't'),  FIELD(last, 8, 't'),
    FIELD(in_ap, 1, 't'),  FIELD(entry_hash, 4, 't'), FIELD(table_hash, 4, 'v'),
    FIELD(est_p, 8, 'T'),  FIELD(est_v, 8, 'T'),      FIELD(g, 8, 't'),
    FIELD(h, 8, 't'),      FIELD(pos, 8, 'L'),        FIELD(vel, 8, 'L'),
    FIELD(cmd, 8, 'L'),    FIELD(goal, 8, 'L'),       FIELD(track, 8, 'S'),
    FIELD(active, 1, 'l'), FIELD(final, 1, 'l'),      FIELD(present, 1, 'l'),
    FIELD(chosen, 2, 'l'), FIELD(reason, 1, 'l'),     FIELD(digest, 4, 'l'),
    FIELD(score, 8, 'l'),  FIELD(sends, 1, 'l'),      FIELD(frame_len, 1, 'l'),
    FIELD(frames, 1, 'F'), FIELD(decay, 8, 'd'),      FIELD(lease_state, 1, 'e'),
};

static Py_ssize_t array_count(const swarm *s, char shape)
{
    const Py_ssize_t n = s->n, l = s->local_count, v = s->table_count;
    switch (shape) {
    case 'l':
        return l;
    case 'v':
        return v;
    case 'N':
        return 3 * n;
    case 'T':
        return 3 * n * v;
    case 't':
        return n * v;
    case 'L':
        return 3 * l;
    case 'S':
        return 3 * l * s->steps;
    case 'F':
        return l * FRAME_MAX;
    case 'd':
        return 2 * (Py_ssize_t)s->decay_len;
    default:
        return s->policy == POLICY_LEASE ? l * lease_state_bytes(s->n, s->lease.anchor_every) : 0;
    }
}

static int read_params(swarm *s, PyObject *p)
{
    int bad = 0;
    s->n = (int)number_or(p, "agents", &bad);
    s->local_count = (int)number_or(p, "local_count", &bad);
    s->table_count = (int)number_or(p, "table_count", &bad);
    s->steps = (int)number_or(p, "steps", &bad);
    s->shared = (int)number_or(p, "shared", &bad);
    s->slot_s = real_or(p, "slot_s", &bad);
    s->policy = (int)number_or(p, "policy", &bad);
    s->estimator = (int)number_or(p, "estimator", &bad);
    s->avoider = (int)number_or(p, "avoider", &bad);
    s->selection = (int)number_or(p, "selection", &bad);
    s->epsilon = real_or(p, "epsilon", &bad);
    s->age_cap = real_or(p, "age_cap", &bad);
    s->boot_round = (int)number_or(p, "boot_round", &bad);
    s->return_every = (int)number_or(p, "return_every", &bad);
    s->r_min = real_or(p, "r_min", &bad);
    s->c_r = (int)number_or(p, "c_r", &bad);
    s->targets_known = (int)number_or(p, "targets_known", &bad);
    s->profile = (int)number_or(p, "profile", &bad);
    s->key = (uint64_t)number_or(p, "key", &bad);
    s->gossip = (int)number_or(p, "gossip", &bad);
    s->position_step = real_or(p, "position_step", &bad);
    s->lease.anchor_every = (int)number_or(p, "anchor_every", &bad);
    s->lease.open_every = (int)number_or(p, "open_every", &bad);
    s->lease.adoption = (int)number_or(p, "adoption", &bad);
    s->lease.depth_rate = real_or(p, "depth_rate", &bad);
    s->lease.share = real_or(p, "share", &bad);
    s->decay_len = (int)number_or(p, "decay_len", &bad);
    s->vehicle.tau = real_or(p, "tau", &bad);
    s->vehicle.a_max = real_or(p, "a_max", &bad);
    PyObject *avoid = PyDict_GetItemString(p, "avoid");
    if (!avoid) {
        PyErr_SetString(PyExc_KeyError, "parameter avoid is missing");
        return -1;
    }
    if (bad || avoid_params_from_dict(avoid, &s->avoid) < 0) return -1;
    if (s->n < 1 || s->local_count < 0 || s->table_count < 0 || s->steps < 1 || s->decay_len < 1) {
        PyErr_SetString(PyExc_ValueError, "sizes must be positive");
        return -1;
    }
    if (!(s->position_step > 0.0)) {
        PyErr_SetString(PyExc_ValueError, "position_step must be positive");
        return -1;
    }
    s->dt = s->slot_s / s->steps;
    return 0;
}

static void swarm_dealloc(SwarmObject *self)
{
    for (int i = 0; i < self->borrowed; i++) PyBuffer_Release(&self->arrays[i]);
    PyMem_Free(self->s.scratch);
    PyMem_Free(self->s.ages);
    PyMem_Free(self->s.own);
    PyMem_Free(self->s.senders);
    Py_TYPE(self)->tp_free((PyObject *)self);
}

static int check_indices(const swarm *s)
{
    for (int l = 0; l < s->local_count; l++)
        if (s->local[l] < 0 || s->local[l] >= s->n) return -1;
    for (int v = 0; v < s->table_count; v++)
        if (s->observer[v] < -1 || s->observer[v] >= s->n) return -1;
    if (s->local_count && s->table_count < (s->shared ? 1 : s->local_count)) return -1;
    return 0;
}

static int swarm_init(SwarmObject *self, PyObject *args, PyObject *kwargs)
{
    PyObject *params, *arrays;
    (void)kwargs;
    if (self->borrowed) {
        PyErr_SetString(PyExc_RuntimeError, "a swarm is created once");
        return -1;
    }
    if (!PyArg_ParseTuple(args, "O!O!", &PyDict_Type, &params, &PyDict_Type, &arrays)) return -1;
    swarm *s = &self->s;
    if (read_params(s, params) < 0) return -1;
    for (size_t i = 0; i < sizeof ARRAYS / sizeof *ARRAYS; i++) {
        PyObject *object = PyDict_GetItemString(arrays, ARRAYS[i].name);
        if (!object) {
            PyErr_Format(PyExc_KeyError, "array %s is missing", ARRAYS[i].name);
            return -1;
        }
        if (borrow(object, ARRAYS[i].name, array_count(s, ARRAYS[i].shape), ARRAYS[i].itemsize, 1,
                   &self->arrays[i]) < 0)
            return -1;
        self->borrowed = (int)i + 1;
        *(void **)((char *)s + ARRAYS[i].offset) = self->arrays[i].buf;
    }
    if (check_indices(s) < 0) {
        PyErr_SetString(PyExc_ValueError, "local or observer out of range");
        return -1;
    }
    if (s->shared && s->policy == POLICY_LEASE) {
        PyErr_SetString(PyExc_ValueError, "policy lease: every agent needs a table of its own");
        return -1;
    }
    const size_t avoid = (size_t)avoid_scratch_doubles(s->n),
                 table = (size_t)(6 * s->n + priority_scratch_doubles(s->n));
    s->scratch = PyMem_Calloc(avoid > table ? avoid : table, sizeof(double));
    s->ages = PyMem_Calloc((size_t)s->n, sizeof(double));
    s->own = PyMem_Calloc((size_t)s->local_count + 1, sizeof(dtsa_frame));
    s->senders = PyMem_Calloc((size_t)s->local_count + 1, sizeof(int32_t));
    if (!s->scratch || !s->ages || !s->own || !s->senders) {
        PyErr_NoMemory();
        return -1;
    }
    swarm_reset_tables(s);
    return 0;
}

static PyObject *py_decide(SwarmObject *self, PyObject *arg)
{
    int64_t slot;
    if (slot_arg(arg, &slot) < 0) return NULL;
    swarm_decide(&self->s, slot);
    Py_RETURN_NONE;
}

static PyObject *senders_tuple(const swarm *s)
{
    PyObject *tuple = PyTuple_New(s->sender_count);
    if (!tuple) return NULL;
    for (int i = 0; i < s->sender_count; i++)
        PyTuple_SET_ITEM(tuple, i, PyLong_FromLong(s->senders[i]));
    return tuple;
}

static PyObject *py_emit(SwarmObject *self, PyObject *arg)
{
    int64_t slot;
    if (slot_arg(arg, &slot) < 0) return NULL;
    swarm_emit(&self->s, slot);
    return senders_tuple(&self->s);
}

static PyObject *py_begin(SwarmObject *self, PyObject *arg)
{
    int64_t slot;
    if (slot_arg(arg, &slot) < 0) return NULL;
    swarm_decide(&self->s, slot);
    swarm_emit(&self->s, slot);
    return senders_tuple(&self->s);
}

static PyObject *py_fly(SwarmObject *self, PyObject *arg)
{
    int64_t slot;
    if (slot_arg(arg, &slot) < 0) return NULL;
    swarm_fly(&self->s, slot);
    Py_RETURN_NONE;
}

static PyObject *py_end(SwarmObject *self, PyObject *arg)
{
    int64_t slot;
    if (slot_arg(arg, &slot) < 0) return NULL;
    swarm_end(&self->s, slot);
    Py_RETURN_NONE;
}

static int step_of(const swarm *s, PyObject *object, int *step)
{
    *step = (int)PyLong_AsLong(object);
    if (*step == -1 && PyErr_Occurred()) return -1;
    if (*step >= 0 && *step <= s->steps) return 0;
    PyErr_SetString(PyExc_ValueError, "step: allowed: 0 .. control instants in a slot");
    return -1;
}

static PyObject *py_steer(SwarmObject *self, PyObject *const *args, Py_ssize_t count)
{
    int64_t slot;
    int step, estimate = 1;
    if (count < 2 || count > 3)
        return PyErr_Format(PyExc_TypeError, "steer(slot, step, estimate=True)");
    if (slot_arg(args[0], &slot) < 0 || step_of(&self->s, args[1], &step) < 0) return NULL;
    if (count == 3 && (estimate = PyObject_IsTrue(args[2])) < 0) return NULL;
    swarm_steer(&self->s, slot, step, estimate);
    Py_RETURN_NONE;
}

static PyObject *py_move(SwarmObject *self, PyObject *arg)
{
    int step;
    if (step_of(&self->s, arg, &step) < 0) return NULL;
    if (step >= self->s.steps)
        return PyErr_Format(PyExc_ValueError, "step: got %d; allowed: 0 .. %d", step,
                            self->s.steps - 1);
    swarm_move(&self->s, step);
    Py_RETURN_NONE;
}

static PyObject *py_estimate(SwarmObject *self, PyObject *const *args, Py_ssize_t count)
{
    int64_t slot;
    int step = 0;
    if (count < 1 || count > 2) return PyErr_Format(PyExc_TypeError, "estimate(slot, step=0)");
    if (slot_arg(args[0], &slot) < 0 || (count == 2 && step_of(&self->s, args[1], &step) < 0))
        return NULL;
    for (int table = 0; table < self->s.table_count; table++)
        swarm_estimate(&self->s, table, slot, step);
    Py_RETURN_NONE;
}

static PyObject *py_hear(SwarmObject *self, PyObject *const *args, Py_ssize_t count)
{
    int64_t slot;
    Py_buffer data, mask;
    int masked = 0;
    if (count < 2 || count > 3) return PyErr_Format(PyExc_TypeError, "hear(slot, data, mask=None)");
    if (slot_arg(args[0], &slot) < 0) return NULL;
    if (PyObject_GetBuffer(args[1], &data, PyBUF_SIMPLE) < 0) return NULL;
    if (count == 3 && args[2] != Py_None) {
        if (borrow(args[2], "mask", self->s.table_count, 1, 0, &mask) < 0) {
            PyBuffer_Release(&data);
            return NULL;
        }
        masked = 1;
    }
    const int accepted = swarm_hear(&self->s, slot, data.buf, data.len, masked ? mask.buf : NULL);
    PyBuffer_Release(&data);
    if (masked) PyBuffer_Release(&mask);
    return PyBool_FromLong(accepted);
}

static PyObject *py_frame(SwarmObject *self, PyObject *arg)
{
    const long l = PyLong_AsLong(arg);
    if (l == -1 && PyErr_Occurred()) return NULL;
    if (l < 0 || l >= self->s.local_count)
        return PyErr_Format(PyExc_IndexError, "no local agent %ld", l);
    return PyBytes_FromStringAndSize((const char *)self->s.frames + l * FRAME_MAX,
                                     self->s.frame_len[l]);
}

static PyObject *py_restart(SwarmObject *self, PyObject *arg)
{
    const long l = PyLong_AsLong(arg);
    if (l == -1 && PyErr_Occurred()) return NULL;
    if (l < 0 || l >= self->s.local_count)
        return PyErr_Format(PyExc_IndexError, "no local agent %ld", l);
    if (self->s.shared)
        return PyErr_Format(PyExc_ValueError,
                            "restart: agents that share a table cannot restart alone");
    swarm_reset_table(&self->s, (int)l);
    if (self->s.policy == POLICY_LEASE) lease_restart(&self->s, (int)l);
    Py_RETURN_NONE;
}

static PyObject *py_lease_status(SwarmObject *self, PyObject *arg)
{
    const long l = PyLong_AsLong(arg);
    if (l == -1 && PyErr_Occurred()) return NULL;
    if (l < 0 || l >= self->s.local_count)
        return PyErr_Format(PyExc_IndexError, "no local agent %ld", l);
    if (self->s.policy != POLICY_LEASE)
        return PyErr_Format(PyExc_ValueError, "lease_status: the policy is not lease");
    const lease_scope v = lease_of(&self->s, (int)l);
    int alive = 1, absent = 0;
    for (int k = 0; k < v.n; k++) {
        if (k == self->s.local[l]) continue;
        alive += lease_alive(&v, k, v.a->now);
        absent += lease_absent(&v, k, v.a->now);
    }
    return Py_BuildValue("{s:O,s:O,s:L,s:i,s:i,s:i}", "probation",
                         v.a->probation ? Py_True : Py_False, "deaf",
                         v.a->deaf > LEASE_DEAF ? Py_True : Py_False, "woke", (long long)v.a->woke,
                         "alive", alive, "absent", absent, "silent_slots", v.a->deaf);
}

static PyObject *py_reset(SwarmObject *self, PyObject *unused)
{
    (void)unused;
    swarm_reset_tables(&self->s);
    Py_RETURN_NONE;
}

static PyObject *get_malformed(SwarmObject *self, void *closure)
{
    (void)closure;
    return PyLong_FromUnsignedLongLong(self->s.malformed);
}

static PyObject *get_foreign(SwarmObject *self, void *closure)
{
    (void)closure;
    return PyLong_FromUnsignedLongLong(self->s.foreign);
}

static PyMethodDef SWARM_METHODS[] = {
    {"decide", (PyCFunction)py_decide, METH_O,
     "decide(slot): fills chosen, reason, score, digest, sends"},
    {"emit", (PyCFunction)py_emit, METH_O,
     "emit(slot) -> local indices of all that send; encodes their frames"},
    {"begin", (PyCFunction)py_begin, METH_O, "begin(slot): decide and emit"},
    {"fly", (PyCFunction)py_fly, METH_O, "fly(slot): commands and motion during a slot"},
    {"steer", (PyCFunction)(void (*)(void))py_steer, METH_FASTCALL,
     "steer(slot, step, estimate=True): commands at one instant"},
    {"move", (PyCFunction)py_move, METH_O, "move(step): motion over one control period"},
    {"estimate", (PyCFunction)(void (*)(void))py_estimate, METH_FASTCALL,
     "estimate(slot, step=0): fills the estimates"},
    {"hear", (PyCFunction)(void (*)(void))py_hear, METH_FASTCALL,
     "hear(slot, data, mask=None) -> accepted"},
    {"end", (PyCFunction)py_end, METH_O, "end(slot): counters and silence"},
    {"frame", (PyCFunction)py_frame, METH_O,
     "frame(index) -> bytes of a local agent's frame in this slot"},
    {"restart", (PyCFunction)py_restart, METH_O,
     "restart(index): a local agent forgets everything but its settings"},
    {"lease_status", (PyCFunction)py_lease_status, METH_O,
     "lease_status(index) -> dict, policy lease"},
    {"reset", (PyCFunction)py_reset, METH_NOARGS, "reset(): back to the start"},
    {NULL, NULL, 0, NULL},
};

static PyGetSetDef SWARM_GETTERS[] = {
    {"malformed", (getter)get_malformed, NULL, "frames heard that are no frames", NULL},
    {"foreign", (getter)get_foreign, NULL, "frames of unknown agents or of another time", NULL},
    {NULL, NULL, NULL, NULL, NULL},
};

PyTypeObject SwarmType = {
    PyVarObject_HEAD_INIT(NULL, 0).tp_name = "dtsa_agent.core._kernel.Swarm",
    .tp_basicsize = sizeof(SwarmObject),
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_doc = "Agents in slots, on arrays that core/swarm.py owns.",
    .tp_new = PyType_GenericNew,
    .tp_init = (initproc)swarm_init,
    .tp_dealloc = (destructor)swarm_dealloc,
    .tp_methods = SWARM_METHODS,
    .tp_getset = SWARM_GETTERS,
};
