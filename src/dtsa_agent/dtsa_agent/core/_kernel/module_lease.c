/* Python's door to the extended frame; core/frame_extended.py documents it. */
#include "module.h"

#include <string.h>

#include "lease.h"

static PyObject *gossip_tuple(const extended_frame *e)
{
    PyObject *tuple = PyTuple_New(e->gossip_count);
    for (int i = 0; tuple && i < e->gossip_count; i++) {
        const gossip_entry *g = &e->gossip[i];
        PyObject *item = Py_BuildValue("(iii(ddd)(ddd))", g->id, g->age, g->c_r, g->p[0], g->p[1],
                                       g->p[2], g->v[0], g->v[1], g->v[2]);
        if (!item)
            Py_CLEAR(tuple);
        else
            PyTuple_SET_ITEM(tuple, i, item);
    }
    return tuple;
}

static PyObject *relay_list(const extended_frame *e)
{
    PyObject *list = PyList_New(0);
    for (int d = 0, i = 0; list && d < RELAY_REACH; d++) {
        if (!(e->relay_mask >> d & 1)) continue;
        PyObject *item = Py_BuildValue("(ii)", d + 1, e->relay_ids[i++]);
        if (!item || PyList_Append(list, item) < 0) Py_CLEAR(list);
        Py_XDECREF(item);
    }
    return list;
}

static PyObject *py_decode_extended(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    Py_buffer data;
    double step;
    extended_frame e;
    (void)module;
    if (count != 2) return PyErr_Format(PyExc_TypeError, "decode_extended(data, position_step)");
    if (step_arg(args[1], &step) < 0 || PyObject_GetBuffer(args[0], &data, PyBUF_SIMPLE) < 0)
        return NULL;
    const int status = extended_decode(data.buf, data.len, step, &e);
    PyBuffer_Release(&data);
    if (status != FRAME_OK) return PyLong_FromLong(status);
    const dtsa_frame *f = &e.own;
    return Py_BuildValue("{s:i,s:I,s:i,s:(ddd),s:(ddd),s:(ddd),s:i,s:O,s:O,s:N,s:y#,s:N}", "sender",
                         f->sender, "slot", f->slot, "c_r", f->c_r, "position", f->p[0], f->p[1],
                         f->p[2], "velocity", f->v[0], f->v[1], f->v[2], "intent", f->c[0], f->c[1],
                         f->c[2], "c_s", e.c_s, "leaving", e.leaving ? Py_True : Py_False,
                         "probation", e.probation ? Py_True : Py_False, "gossip", gossip_tuple(&e),
                         "leases", (const char *)e.leases, (Py_ssize_t)e.lease_count, "relay",
                         relay_list(&e));
}

static int read_gossip(PyObject *tuple, extended_frame *e)
{
    const Py_ssize_t count = PyTuple_Size(tuple);
    if (count > SECTIONS) return -1;
    for (Py_ssize_t i = 0; i < count; i++) {
        gossip_entry *g = &e->gossip[i];
        if (!PyArg_ParseTuple(PyTuple_GET_ITEM(tuple, i), "iii(ddd)(ddd)", &g->id, &g->age, &g->c_r,
                              &g->p[0], &g->p[1], &g->p[2], &g->v[0], &g->v[1], &g->v[2]))
            return -1;
        if (g->id < 1 || g->id > EXTENDED_SENDER_MAX || g->age < 1 || g->age > GOSSIP_AGE_MAX)
            return -1;
        for (int axis = 0; axis < 3; axis++)
            if (g->p[axis] != g->p[axis] || g->v[axis] != g->v[axis]) return -1;
    }
    e->gossip_count = (int)count;
    return 0;
}

static int read_relay(PyObject *tuple, extended_frame *e)
{
    const Py_ssize_t count = PyTuple_Size(tuple);
    int last = 0;
    if (count > RELAY_IDS) return -1;
    for (Py_ssize_t i = 0; i < count; i++) {
        int ahead, id;
        if (!PyArg_ParseTuple(PyTuple_GET_ITEM(tuple, i), "ii", &ahead, &id)) return -1;
        if (ahead <= last || ahead > RELAY_REACH || id < 1 || id > 255) return -1;
        e->relay_mask |= 1u << (ahead - 1);
        e->relay_ids[i] = (uint8_t)id;
        last = ahead;
    }
    return 0;
}

static PyObject *py_encode_extended(PyObject *module, PyObject *args)
{
    extended_frame e = {.own = {.profile = PROFILE_EXTENDED}};
    dtsa_frame *f = &e.own;
    const char *leases;
    Py_ssize_t lease_count;
    PyObject *gossip, *relay, *step_object;
    double step;
    uint8_t out[FRAME_MAX];
    (void)module;
    if (!PyArg_ParseTuple(args, "iIi(ddd)(ddd)(ddd)ippO!y#O!O", &f->sender, &f->slot, &f->c_r,
                          &f->p[0], &f->p[1], &f->p[2], &f->v[0], &f->v[1], &f->v[2], &f->c[0],
                          &f->c[1], &f->c[2], &e.c_s, &e.leaving, &e.probation, &PyTuple_Type,
                          &gossip, &leases, &lease_count, &PyTuple_Type, &relay, &step_object) ||
        step_arg(step_object, &step) < 0)
        return NULL;
    const int bad = lease_count > SECTIONS * SECTION_BYTES || e.c_s < 0 || e.c_s > 253 ||
                    read_gossip(gossip, &e) < 0 || read_relay(relay, &e) < 0;
    if (PyErr_Occurred()) return NULL;
    if (bad) return PyBytes_FromStringAndSize("", 0);
    memcpy(e.leases, leases, (size_t)lease_count);
    e.lease_count = (int)lease_count;
    return PyBytes_FromStringAndSize((const char *)out, extended_encode(&e, step, out));
}

static PyObject *py_lease_state_bytes(PyObject *module, PyObject *args)
{
    int n, every;
    (void)module;
    if (!PyArg_ParseTuple(args, "ii", &n, &every)) return NULL;
    return PyLong_FromLong(lease_state_bytes(n, every));
}

PyMethodDef lease_methods[] = {
    {"lease_state_bytes", py_lease_state_bytes, METH_VARARGS,
     "lease_state_bytes(agents, anchor_every) -> bytes of state of one agent"},
    {"decode_extended", (PyCFunction)(void (*)(void))py_decode_extended, METH_FASTCALL,
     "decode_extended(data, position_step) -> dict, or a negative error"},
    {"encode_extended", py_encode_extended, METH_VARARGS,
     "encode_extended(sender, slot, c_r, p, v, c, c_s, leaving, probation, gossip, leases, relay, "
     "position_step) -> bytes, empty if not encodable"},
    {NULL, NULL, 0, NULL},
};
