/* The binding of what an agent hears to Python: it waits, reads the port, and lets the hearing take
 * in what has arrived; _hearing.pyi says what each method does. In the limited API. */
#define Py_LIMITED_API 0x030A0000
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <errno.h>
#include <poll.h>
#include <string.h>
#include <time.h>

#include "hearing.h"

static const int64_t SECOND = 1000000000,
                     PATIENCE = 50000000; /* a signal is noticed after this time at the latest */

typedef struct object {
    PyObject head;
    hearing *h;
    PyObject *capsule; /* keeps the port */
    air_port *port;
    arrived batch[BURST];
    int count, at; /* of the batch; of these looked at */
} object;

static hearing *of(PyObject *self) { return ((object *)self)->h; }
static air_port *port_of(PyObject *self) { return ((object *)self)->port; }

static int64_t now_monotonic(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (int64_t)t.tv_sec * SECOND + t.tv_nsec;
}

static PyObject *make(PyTypeObject *type, PyObject *args, PyObject *unused)
{
    const char *header, *key;
    Py_ssize_t header_length, key_length;
    int id, anchor_every;
    long long moving, resting, named;
    long long slot_ns, flight, limit, trust, began, offset, drift;
    unsigned long long seed, session;
    hearing *h = PyMem_Calloc(1, sizeof *h);
    PyObject *self = NULL, *capsule;
    air_port *port;
    (void)unused;
    if (!h) return PyErr_NoMemory();
    if (!PyArg_ParseTuple(args, "iiiLKy#iiy#KLdiiLLLLLLLLO", &h->agents, &id, &anchor_every,
                          &slot_ns, &seed, &header, &header_length, &h->late_bytes, &h->peers, &key,
                          &key_length, &session, &flight, &h->position_step, &h->length,
                          &h->own_bytes, &limit, &trust, &began, &offset, &drift, &moving, &resting,
                          &named, &capsule))
        goto failed;
    port = PyCapsule_GetPointer(capsule, DTSA_PORT);
    if (!port) goto failed;
    if (h->agents < 1 || h->agents > DTSA_AGENTS_MAX || id < 1 || id > h->agents ||
        header_length > WITH_MAGIC || (h->late_bytes && h->late_bytes != 2) || h->peers < 0 ||
        h->peers > PEERS || key_length > (Py_ssize_t)sizeof h->key || h->length > LONGEST ||
        h->length <= header_length + h->late_bytes + 4 * h->peers + DTSA_TAG_BYTES ||
        h->own_bytes < 0 || trust < 1 || drift < -DRIFT_MOST || drift > DRIFT_MOST ||
        !(h->position_step > 0.0) ||
        !dtsa_timebase_init(&h->base, h->agents, anchor_every, slot_ns, id, seed)) {
        PyErr_SetString(PyExc_ValueError, "what is heard: a value is out of range");
        goto failed;
    }
    memcpy(h->header, header, (size_t)header_length);
    h->agreed = (int)header_length;
    h->head = h->agreed + h->late_bytes + 4 * h->peers;
    memcpy(h->key, key, (size_t)key_length);
    h->self = id - 1;
    h->key_length = (int)key_length;
    h->session = session;
    h->flight = flight;
    h->slot_ns = slot_ns;
    h->delay.limit = limit;
    h->base.aligner.limit_ns = trust;
    h->contact.moving = moving;
    h->contact.resting = resting;
    h->contact.named = named;
    h->clock = (own_clock){began, offset, drift};
    if (!hearing_open(h)) {
        PyErr_NoMemory();
        goto failed;
    }
    self = ((allocfunc)PyType_GetSlot(type, Py_tp_alloc))(type, 0);
    if (self) {
        object *o = (object *)self;
        o->h = h;
        o->port = port;
        o->capsule = Py_NewRef(capsule);
        return self;
    }
    hearing_close(h);
failed:
    PyMem_Free(h);
    return NULL;
}

static void drop(PyObject *self)
{
    PyTypeObject *type = Py_TYPE(self);
    if (of(self)) hearing_close(of(self));
    PyMem_Free(of(self));
    Py_XDECREF(((object *)self)->capsule);
    ((freefunc)PyType_GetSlot(type, Py_tp_free))(self);
    Py_DECREF(type);
}

/* ---- waiting ---- */

static int64_t due(const hearing *h, int64_t slot, int64_t lead)
{
    return clock_monotonic(&h->clock, dtsa_timebase_slot_start(&h->base, slot) - lead);
}

/* Whether it is that time; it sleeps a while at most. -1: a signal's handler has raised. */
static int slept_until(int64_t until)
{
    const int64_t now = now_monotonic(), end = until < now + PATIENCE ? until : now + PATIENCE;
    const struct timespec at = {end / SECOND, end % SECOND};
    int fault;
    if (until <= now) return 1;
    Py_BEGIN_ALLOW_THREADS;
    fault = clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &at, NULL);
    Py_END_ALLOW_THREADS;
    if (fault && PyErr_CheckSignals() < 0) return -1;
    return now_monotonic() >= until;
}

static int whole(PyObject *const *args, Py_ssize_t count, Py_ssize_t wanted, int64_t *out)
{
    if (count != wanted) return PyErr_Format(PyExc_TypeError, "%zd arguments", count), 0;
    for (Py_ssize_t i = 0; i < count; i++) {
        out[i] = PyLong_AsLongLong(args[i]);
        if (out[i] == -1 && PyErr_Occurred()) return 0;
    }
    return 1;
}

static PyObject *sleep_until(PyObject *self, PyObject *const *args, Py_ssize_t count)
{
    int64_t v[2];
    if (!whole(args, count, 2, v)) return NULL;
    const int came = slept_until(due(of(self), v[0], v[1]));
    return came < 0 ? NULL : PyBool_FromLong(came);
}

static PyObject *await_frame(PyObject *self, PyObject *const *args, Py_ssize_t count)
{
    int64_t v[1];
    if (!whole(args, count, 1, v)) return NULL;
    int64_t left = v[0] - now_monotonic();
    if (left > PATIENCE) left = PATIENCE;
    if (left > 0) {
        struct pollfd end = {port_of(self)->descriptor, POLLIN, 0};
        const struct timespec most = {0, left};
        Py_BEGIN_ALLOW_THREADS;
        ppoll(&end, 1, &most, NULL);
        Py_END_ALLOW_THREADS;
        if (PyErr_CheckSignals() < 0) return NULL;
    }
    Py_RETURN_NONE;
}

/* ---- what is heard ---- */

static PyObject *bytes(const uint8_t *data, long length)
{
    return PyBytes_FromStringAndSize((const char *)data, length);
}

static PyObject *heard_frame(const hearing *h, const said *s, const uint8_t *data, long length,
                             int64_t arrival)
{
    return Py_BuildValue("(iLNNL)", s->sender, (long long)s->slot, bytes(s->frame, s->frame_length),
                         bytes(data, length), (long long)clock_local(&h->clock, arrival));
}

static int append(PyObject **list, PyObject *made)
{
    if (made && !*list) *list = PyList_New(0);
    const int fault = !made || !*list || PyList_Append(*list, made) < 0;
    Py_XDECREF(made);
    return fault;
}

static PyObject *or_none(PyObject *list) { return list ? list : Py_NewRef(Py_None); }

/* Up to a frame with which another time is taken over: the agent begins anew before it hears on. */
static PyObject *heard(object *o)
{
    hearing *h = o->h;
    PyObject *taken = NULL, *refused = NULL;
    int restarted = 0, fault = 0, full;
    if (o->at == o->count) {
        o->count = o->port->receive(o->port, o->batch);
        o->at = 0;
    }
    full = o->count == BURST;
    while (o->at < o->count && !restarted && !fault) {
        const arrived *a = &o->batch[o->at++];
        said s;
        if (a->own) continue;
        const verdict v = hearing_take(h, a->data, a->length, a->arrival, &s, &restarted);
        if (v == TAKEN)
            fault = append(&taken, heard_frame(h, &s, a->data, a->length, a->arrival));
        else
            fault = append(&refused,
                           Py_BuildValue("(iLNL)", (int)v, v == OWN_NAME ? (long long)s.slot : 0LL,
                                         bytes(a->data, a->length),
                                         (long long)clock_local(&h->clock, a->arrival)));
    }
    if (fault) {
        Py_XDECREF(taken);
        Py_XDECREF(refused);
        return NULL;
    }
    return Py_BuildValue("(NNNN)", or_none(taken), or_none(refused), PyBool_FromLong(restarted),
                         PyBool_FromLong(full || o->at < o->count));
}

static PyObject *take(PyObject *self, PyObject *unused)
{
    (void)unused;
    return heard((object *)self);
}

static PyObject *hear_by(PyObject *self, PyObject *const *args, Py_ssize_t count)
{
    int64_t v[2];
    if (!whole(args, count, 2, v)) return NULL;
    const int came = slept_until(due(of(self), v[0], v[1]));
    if (came < 0) return NULL;
    return came ? heard((object *)self) : Py_NewRef(Py_None);
}

static PyObject *take_one(PyObject *self, PyObject *args)
{
    const char *data;
    Py_ssize_t length;
    long long arrival;
    int restarted;
    said s = {0};
    if (!PyArg_ParseTuple(args, "y#L", &data, &length, &arrival)) return NULL;
    const verdict v =
        hearing_take(of(self), (const uint8_t *)data, (long)length, arrival, &s, &restarted);
    if (v == TAKEN)
        return Py_BuildValue(
            "(iNN)", (int)v, PyBool_FromLong(restarted),
            heard_frame(of(self), &s, (const uint8_t *)data, (long)length, arrival));
    return Py_BuildValue("(iOO)", (int)v, Py_False, Py_None);
}

/* ---- time ---- */

static PyObject *start(PyObject *self, PyObject *unused)
{
    hearing *h = of(self);
    (void)unused;
    return PyLong_FromLongLong(clock_monotonic(
        &h->clock, dtsa_timebase_start(&h->base, clock_local(&h->clock, now_monotonic()))));
}

static PyObject *wake(PyObject *self, PyObject *unused)
{
    hearing *h = of(self);
    (void)unused;
    return PyBool_FromLong(dtsa_timebase_wake(&h->base, clock_local(&h->clock, now_monotonic())));
}

static PyObject *late_ns(PyObject *self, PyObject *const *args, Py_ssize_t count)
{
    int64_t v[1];
    return whole(args, count, 1, v) ? PyLong_FromLongLong(now_monotonic() - due(of(self), v[0], 0))
                                    : NULL;
}

static PyObject *hear_slot(PyObject *self, PyObject *const *args, Py_ssize_t count)
{
    int64_t v[2];
    return whole(args, count, 2, v) ? PyLong_FromLong(slots_hear(of(self), v[0], v[1])) : NULL;
}

static PyObject *slot_at(PyObject *self, PyObject *const *args, Py_ssize_t count)
{
    int64_t v[1];
    return whole(args, count, 1, v) ? PyLong_FromLongLong(dtsa_timebase_slot(&of(self)->base, v[0]))
                                    : NULL;
}

static PyObject *slot_start_ns(PyObject *self, PyObject *const *args, Py_ssize_t count)
{
    int64_t v[1];
    return whole(args, count, 1, v)
               ? PyLong_FromLongLong(dtsa_timebase_slot_start(&of(self)->base, v[0]))
               : NULL;
}

static PyObject *local_ns(PyObject *self, PyObject *const *args, Py_ssize_t count)
{
    int64_t v[1];
    return whole(args, count, 1, v) ? PyLong_FromLongLong(clock_local(&of(self)->clock, v[0]))
                                    : NULL;
}

static PyObject *wrap(PyObject *self, PyObject *args)
{
    hearing *h = of(self);
    const char *frame;
    Py_ssize_t length;
    long long slot, late;
    uint8_t out[LONGEST];
    if (!PyArg_ParseTuple(args, "y#LL", &frame, &length, &slot, &late)) return NULL;
    if (length != h->length - h->head - (h->key_length ? DTSA_TAG_BYTES : 0))
        return PyErr_Format(PyExc_ValueError, "a frame of %zd bytes", length);
    hearing_wrap(h, (const uint8_t *)frame, slot, late, out);
    return bytes(out, h->length);
}

static PyObject *status(PyObject *self, PyObject *unused)
{
    const hearing *h = of(self);
    (void)unused;
    return Py_BuildValue("(iIIIL)", h->base.state, h->base.restarts, h->corrected,
                         h->base.aligner.corrections, (long long)h->delay.error);
}

static PyObject *contacts_at(PyObject *self, PyObject *const *args, Py_ssize_t count)
{
    int64_t v[2];
    if (!whole(args, count, 2, v)) return NULL;
    const contact_count n = contacts_count(&of(self)->contact, v[0], v[1] != 0);
    return Py_BuildValue("(iiii)", n.there, n.hears, n.heard_by, n.both);
}

static PyObject *timing(PyObject *self, PyObject *unused)
{
    (void)unused;
    return Py_BuildValue("(LL)", (long long)of(self)->timed, (long long)of(self)->off);
}

static PyObject *listening(PyObject *self, void *unused)
{
    (void)unused;
    return PyBool_FromLong(of(self)->base.state == DTSA_LISTENING);
}

/* ---- the module ---- */

#define FAST(f) (PyCFunction)(void (*)(void)) f, METH_FASTCALL, NULL

static PyMethodDef METHODS[] = {
    {"listen", FAST(hear_by)},
    {"take", take, METH_NOARGS, NULL},
    {"take_one", take_one, METH_VARARGS, NULL},
    {"sleep_until", FAST(sleep_until)},
    {"await_frame", FAST(await_frame)},
    {"late_ns", FAST(late_ns)},
    {"start", start, METH_NOARGS, NULL},
    {"wake", wake, METH_NOARGS, NULL},
    {"hear_slot", FAST(hear_slot)},
    {"slot_at", FAST(slot_at)},
    {"slot_start_ns", FAST(slot_start_ns)},
    {"local_ns", FAST(local_ns)},
    {"wrap", wrap, METH_VARARGS, NULL},
    {"status", status, METH_NOARGS, NULL},
    {"contact", FAST(contacts_at)},
    {"timing", timing, METH_NOARGS, NULL},
    {0},
};

static PyGetSetDef FIELDS[] = {{"listening", listening, NULL, NULL, NULL}, {0}};

static PyType_Slot SLOTS[] = {{Py_tp_new, make},
                              {Py_tp_dealloc, drop},
                              {Py_tp_methods, METHODS},
                              {Py_tp_getset, FIELDS},
                              {0, NULL}};

static PyType_Spec SPEC = {"dtsa_agent.air._hearing.Hearing", sizeof(object), 0, Py_TPFLAGS_DEFAULT,
                           SLOTS};

static int fill_module(PyObject *module)
{
    PyObject *type = PyType_FromSpec(&SPEC);
    const int fault = type ? PyModule_AddObjectRef(module, "Hearing", type) : -1;
    Py_XDECREF(type);
    return fault;
}

PyMODINIT_FUNC PyInit__hearing(void)
{
    static PyModuleDef_Slot slots[] = {{Py_mod_exec, fill_module}, {0, NULL}};
    static struct PyModuleDef def = {PyModuleDef_HEAD_INIT, .m_name = "dtsa_agent.air._hearing",
                                     .m_slots = slots};
    return PyModuleDef_Init(&def);
}
