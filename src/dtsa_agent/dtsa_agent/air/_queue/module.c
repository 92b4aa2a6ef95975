/* A queue as the port of an agent (air/_hearing/port.h): a thread that reads a device puts in the
 * datagrams that have arrived; _queue.pyi says what each function does. Python's lock is held on
 * both sides. In the limited API. */
#define Py_LIMITED_API 0x030A0000
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <string.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include "port.h"

enum { ROOM = 64 }; /* datagrams */

typedef struct place {
    uint8_t data[LONGEST];
    long length;
    int64_t arrival;
    int own;
} place;

typedef struct queue {
    air_port port;               /* the first member: receive() is called with it */
    unsigned first, count, lent; /* of these the first `lent` are being looked at */
    unsigned overflowed;
    place places[ROOM];
} queue;

static int receive(air_port *port, arrived batch[BURST])
{
    queue *q = (queue *)port;
    uint64_t told;
    int count = 0;
    q->first = (q->first + q->lent) % ROOM;
    q->count -= q->lent;
    for (; count < BURST && (unsigned)count < q->count; count++) {
        const place *p = &q->places[(q->first + (unsigned)count) % ROOM];
        batch[count] = (arrived){p->data, p->length, p->arrival, p->own};
    }
    q->lent = (unsigned)count;
    if (q->lent == q->count) (void)!read(port->descriptor, &told, sizeof told);
    return count;
}

static queue *queue_of(PyObject *capsule)
{
    queue *q = PyCapsule_GetPointer(capsule, DTSA_PORT);
    if (!q || q->port.receive == receive) return q;
    PyErr_SetString(PyExc_TypeError, "the port of something else");
    return NULL;
}

static void close_queue(PyObject *capsule)
{
    queue *q = PyCapsule_GetPointer(capsule, DTSA_PORT);
    close(q->port.descriptor);
    PyMem_Free(q);
}

static PyObject *open_queue(PyObject *module, PyObject *unused)
{
    queue *q = PyMem_Calloc(1, sizeof *q);
    PyObject *capsule;
    (void)module;
    (void)unused;
    if (!q) return PyErr_NoMemory();
    q->port = (air_port){eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC), receive};
    if (q->port.descriptor < 0) {
        PyMem_Free(q);
        return PyErr_SetFromErrno(PyExc_OSError);
    }
    capsule = PyCapsule_New(q, DTSA_PORT, close_queue);
    if (!capsule) {
        close(q->port.descriptor);
        PyMem_Free(q);
    }
    return capsule;
}

static PyObject *put(PyObject *module, PyObject *args)
{
    PyObject *capsule;
    const char *data;
    Py_ssize_t length;
    long long arrival;
    int own;
    const uint64_t one = 1;
    (void)module;
    if (!PyArg_ParseTuple(args, "Oy#Lp", &capsule, &data, &length, &arrival, &own)) return NULL;
    queue *q = queue_of(capsule);
    if (!q) return NULL;
    if (q->count == ROOM) {
        q->overflowed++;
        Py_RETURN_FALSE;
    }
    place *p = &q->places[(q->first + q->count++) % ROOM];
    p->length = length < LONGEST ? (long)length : LONGEST;
    p->arrival = arrival;
    p->own = own;
    memcpy(p->data, data, (size_t)p->length);
    (void)!write(q->port.descriptor, &one, sizeof one);
    Py_RETURN_TRUE;
}

static PyObject *descriptor(PyObject *module, PyObject *capsule)
{
    const queue *q = queue_of(capsule);
    (void)module;
    return q ? PyLong_FromLong(q->port.descriptor) : NULL;
}

static PyObject *overflowed(PyObject *module, PyObject *capsule)
{
    const queue *q = queue_of(capsule);
    (void)module;
    return q ? PyLong_FromUnsignedLong(q->overflowed) : NULL;
}

/* Of a listener, which has no compiled hearing. */
static PyObject *get(PyObject *module, PyObject *capsule)
{
    queue *q = queue_of(capsule);
    arrived batch[BURST];
    (void)module;
    if (!q) return NULL;
    const int count = receive(&q->port, batch);
    PyObject *list = PyList_New(0);
    for (int i = 0; list && i < count; i++) {
        PyObject *one =
            Py_BuildValue("(y#LN)", (const char *)batch[i].data, (Py_ssize_t)batch[i].length,
                          (long long)batch[i].arrival, PyBool_FromLong(batch[i].own));
        if (!one || PyList_Append(list, one) < 0) Py_CLEAR(list);
        Py_XDECREF(one);
    }
    return list;
}

static PyMethodDef FUNCTIONS[] = {
    {"open_queue", open_queue, METH_NOARGS, NULL},
    {"put", put, METH_VARARGS, NULL},
    {"get", get, METH_O, NULL},
    {"descriptor", descriptor, METH_O, NULL},
    {"overflowed", overflowed, METH_O, NULL},
    {0},
};

PyMODINIT_FUNC PyInit__queue(void)
{
    static PyModuleDef_Slot slots[] = {{0, NULL}};
    static struct PyModuleDef def = {PyModuleDef_HEAD_INIT, .m_name = "dtsa_agent.air._queue",
                                     .m_methods = FUNCTIONS, .m_slots = slots};
    return PyModuleDef_Init(&def);
}
