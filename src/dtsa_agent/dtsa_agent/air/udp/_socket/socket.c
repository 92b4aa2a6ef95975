/* A socket as the port of an agent (air/_hearing/port.h): datagrams from the kernel, with the times
 * at which they arrived, and its binding to Python; _socket.pyi says what each function does. In
 * the limited API. */
#define Py_LIMITED_API 0x030A0000
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <errno.h>
#include <netinet/in.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/uio.h>
#include <time.h>

#include "port.h"
#include "stamps.h"

static const int64_t SECOND = 1000000000;
enum { STAMP = 35, NOTES = 64 }; /* SO_TIMESTAMPNS of Linux; bytes for a stamp beside a datagram */

typedef struct datagram {
    struct sockaddr_in source;
    struct iovec room;
    uint8_t data[LONGEST];
    _Alignas(struct cmsghdr) uint8_t notes[NOTES];
} datagram;

typedef struct socket_port {
    air_port port;              /* the first member: receive() is called with it */
    struct sockaddr_in address; /* what comes from there this very agent has sent */
    stamp_clock stamps;
    unsigned unreadable;
    struct mmsghdr vector[BURST];
    datagram batch[BURST];
} socket_port;

static int64_t stamp_of(struct msghdr *message)
{
    for (struct cmsghdr *note = CMSG_FIRSTHDR(message); note; note = CMSG_NXTHDR(message, note)) {
        struct timespec t;
        if (note->cmsg_level != SOL_SOCKET || note->cmsg_type != STAMP) continue;
        if (note->cmsg_len < CMSG_LEN(sizeof t)) continue;
        memcpy(&t, CMSG_DATA(note), sizeof t);
        return (int64_t)t.tv_sec * SECOND + t.tv_nsec;
    }
    return -1;
}

static void prepare(socket_port *s)
{
    for (int i = 0; i < BURST; i++) {
        datagram *d = &s->batch[i];
        d->room = (struct iovec){d->data, LONGEST};
        s->vector[i].msg_hdr = (struct msghdr){.msg_name = &d->source,
                                               .msg_namelen = sizeof d->source,
                                               .msg_iov = &d->room,
                                               .msg_iovlen = 1,
                                               .msg_control = d->notes,
                                               .msg_controllen = NOTES};
    }
}

static int receive(air_port *port, arrived batch[BURST])
{
    socket_port *s = (socket_port *)port;
    prepare(s);
    const int count = recvmmsg(port->descriptor, s->vector, BURST, MSG_DONTWAIT, NULL);
    if (count < 0 && errno != EAGAIN && errno != EWOULDBLOCK && errno != EINTR)
        s->unreadable++; /* an interface that has gone, for example: it may come back */
    if (count <= 0) return 0;
    stamps_look(&s->stamps); /* afterwards: however long this process was kept waiting, all have
                                arrived before */
    for (int i = 0; i < count; i++) {
        const struct sockaddr_in *source = &s->batch[i].source;
        batch[i] = (arrived){.data = s->batch[i].data,
                             .length = (long)s->vector[i].msg_len,
                             .arrival = stamps_arrival(&s->stamps, stamp_of(&s->vector[i].msg_hdr)),
                             .own = source->sin_port == s->address.sin_port &&
                                    source->sin_addr.s_addr == s->address.sin_addr.s_addr};
    }
    return count;
}

/* ---- the binding ---- */

static void close_port(PyObject *capsule) { PyMem_Free(PyCapsule_GetPointer(capsule, DTSA_PORT)); }

static int read_address(socket_port *s, const char *address, Py_ssize_t length, int number)
{
    if (length != 4) return PyErr_Format(PyExc_ValueError, "an address of %zd bytes", length), 0;
    memcpy(&s->address.sin_addr.s_addr, address, 4);
    s->address.sin_port = htons((uint16_t)number);
    return 1;
}

static PyObject *open_port(PyObject *module, PyObject *args)
{
    const char *address;
    Py_ssize_t length;
    int descriptor, number;
    PyObject *capsule;
    (void)module;
    if (!PyArg_ParseTuple(args, "iy#i", &descriptor, &address, &length, &number)) return NULL;
    socket_port *s = PyMem_Calloc(1, sizeof *s);
    if (!s) return PyErr_NoMemory();
    if (!read_address(s, address, length, number)) {
        PyMem_Free(s);
        return NULL;
    }
    s->port = (air_port){descriptor, receive};
    stamps_look(&s->stamps);
    s->stamps.usable = 1;
    s->stamps.steps = 0;
    capsule = PyCapsule_New(s, DTSA_PORT, close_port);
    if (!capsule) PyMem_Free(s);
    return capsule;
}

static PyObject *set_address(PyObject *module, PyObject *args)
{
    const char *address;
    Py_ssize_t length;
    int number;
    PyObject *capsule;
    (void)module;
    if (!PyArg_ParseTuple(args, "Oy#i", &capsule, &address, &length, &number)) return NULL;
    socket_port *s = PyCapsule_GetPointer(capsule, DTSA_PORT);
    if (!s || !read_address(s, address, length, number)) return NULL;
    Py_RETURN_NONE;
}

static PyObject *counts(PyObject *module, PyObject *capsule)
{
    const socket_port *s = PyCapsule_GetPointer(capsule, DTSA_PORT);
    (void)module;
    return s ? Py_BuildValue("(II)", s->unreadable, s->stamps.steps) : NULL;
}

static PyObject *stamped(PyObject *module, PyObject *args)
{
    PyObject *capsule;
    long long ahead, now, stamp;
    (void)module;
    if (!PyArg_ParseTuple(args, "OLLL", &capsule, &ahead, &now, &stamp)) return NULL;
    socket_port *s = PyCapsule_GetPointer(capsule, DTSA_PORT);
    if (!s) return NULL;
    stamps_looked(&s->stamps, ahead, now);
    return PyLong_FromLongLong(stamps_arrival(&s->stamps, stamp));
}

static PyMethodDef FUNCTIONS[] = {
    {"open_port", open_port, METH_VARARGS, NULL},
    {"set_address", set_address, METH_VARARGS, NULL},
    {"counts", counts, METH_O, NULL},
    {"stamped", stamped, METH_VARARGS, NULL},
    {0},
};

PyMODINIT_FUNC PyInit__socket(void)
{
    static PyModuleDef_Slot slots[] = {{0, NULL}};
    static struct PyModuleDef def = {PyModuleDef_HEAD_INIT, .m_name = "dtsa_agent.air.udp._socket",
                                     .m_methods = FUNCTIONS, .m_slots = slots};
    return PyModuleDef_Init(&def);
}
