/* Python's door to the compiled core. Arrays come in through the buffer protocol and are borrowed, not copied, so that
 * Python and C look at the same memory; core/swarm.py creates and documents them. */
#include "module.h"

#include "lease.h"

int borrow(PyObject *object, const char *name, Py_ssize_t count, Py_ssize_t itemsize, int writable,
           Py_buffer *out)
{
    const int flags = PyBUF_C_CONTIGUOUS | (writable ? PyBUF_WRITABLE : 0);
    if (PyObject_GetBuffer(object, out, flags) < 0) return -1;
    if (out->itemsize != itemsize || out->len != count * itemsize) {
        PyErr_Format(PyExc_ValueError, "%s: %zd bytes of items of %zd, expected %zd items of %zd",
                     name, out->len, out->itemsize, count, itemsize);
        PyBuffer_Release(out);
        return -1;
    }
    return 0;
}

int slot_arg(PyObject *object, int64_t *slot)
{
    *slot = PyLong_AsLongLong(object);
    return *slot == -1 && PyErr_Occurred() ? -1 : 0;
}

static PyObject *py_priority(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    Py_buffer p, v, g, scratch;
    (void)module;
    if (count != 5)
        return PyErr_Format(PyExc_TypeError, "priority(position, velocity, slot_s, out, scratch)");
    const double slot_s = PyFloat_AsDouble(args[2]);
    if (slot_s == -1.0 && PyErr_Occurred()) return NULL;
    if (PyObject_GetBuffer(args[3], &g, PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE) < 0) return NULL;
    const Py_ssize_t n = g.len / (Py_ssize_t)sizeof(double);
    PyObject *result = NULL;
    if (borrow(args[0], "position", 3 * n, 8, 0, &p) == 0) {
        if (borrow(args[1], "velocity", 3 * n, 8, 0, &v) == 0) {
            if (borrow(args[4], "scratch", 7 * n, 8, 1, &scratch) == 0) {
                priority_values((int)n, slot_s, p.buf, v.buf, g.buf, scratch.buf);
                result = Py_NewRef(Py_None);
                PyBuffer_Release(&scratch);
            }
            PyBuffer_Release(&v);
        }
        PyBuffer_Release(&p);
    }
    PyBuffer_Release(&g);
    return result;
}

static PyObject *py_select(PyObject *module, PyObject *args)
{
    PyObject *g_object, *h_object, *ap_object, *candidates_object;
    double epsilon;
    int selection;
    Py_buffer g, h, ap, candidates;
    (void)module;
    if (!PyArg_ParseTuple(args, "OOOdiO", &g_object, &h_object, &ap_object, &epsilon, &selection,
                          &candidates_object))
        return NULL;
    if (PyObject_GetBuffer(g_object, &g, PyBUF_C_CONTIGUOUS) < 0) return NULL;
    const Py_ssize_t n = g.len / 8;
    PyObject *result = NULL;
    if (borrow(h_object, "counter", n, 8, 0, &h) == 0) {
        if (borrow(ap_object, "in_ap", n, 1, 0, &ap) == 0) {
            if (borrow(candidates_object, "candidates", n, 1, 1, &candidates) == 0) {
                int reason;
                const int k = select_sender((int)n, selection, epsilon, g.buf, h.buf, ap.buf,
                                            candidates.buf, &reason);
                result = Py_BuildValue("(ii)", k, reason);
                PyBuffer_Release(&candidates);
            }
            PyBuffer_Release(&ap);
        }
        PyBuffer_Release(&h);
    }
    PyBuffer_Release(&g);
    return result;
}

int step_arg(PyObject *object, double *step)
{
    *step = PyFloat_AsDouble(object);
    if (*step == -1.0 && PyErr_Occurred()) return -1;
    if (*step > 0.0) return 0;
    PyErr_SetString(PyExc_ValueError, "position_step: allowed: more than 0 m");
    return -1;
}

static PyObject *py_encode(PyObject *module, PyObject *args)
{
    dtsa_frame f;
    double step;
    PyObject *step_object;
    uint8_t out[FRAME_MAX];
    (void)module;
    if (!PyArg_ParseTuple(args, "iiIi(ddd)(ddd)(ddd)O", &f.profile, &f.sender, &f.slot, &f.c_r,
                          &f.p[0], &f.p[1], &f.p[2], &f.v[0], &f.v[1], &f.v[2], &f.c[0], &f.c[1],
                          &f.c[2], &step_object) ||
        step_arg(step_object, &step) < 0)
        return NULL;
    const int length = frame_encode(&f, step, out);
    return PyBytes_FromStringAndSize((const char *)out, length);
}

static PyObject *py_decode(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    Py_buffer data;
    double step;
    dtsa_frame f;
    (void)module;
    if (count != 2) return PyErr_Format(PyExc_TypeError, "decode(data, position_step)");
    if (step_arg(args[1], &step) < 0 || PyObject_GetBuffer(args[0], &data, PyBUF_SIMPLE) < 0)
        return NULL;
    const int status = frame_decode(data.buf, data.len, step, &f);
    PyBuffer_Release(&data);
    if (status != FRAME_OK) return PyLong_FromLong(status);
    return Py_BuildValue("(iiIi(ddd)(ddd)(ddd))", f.profile, f.sender, f.slot, f.c_r, f.p[0],
                         f.p[1], f.p[2], f.v[0], f.v[1], f.v[2], f.c[0], f.c[1], f.c[2]);
}

static PyObject *py_frame_length(PyObject *module, PyObject *arg)
{
    const long profile = PyLong_AsLong(arg);
    (void)module;
    if (profile == -1 && PyErr_Occurred()) return NULL;
    return PyLong_FromLong(frame_length((int)profile));
}

static PyMethodDef METHODS[] = {
    {"priority", (PyCFunction)(void (*)(void))py_priority, METH_FASTCALL,
     "priority(position, velocity, slot_s, out, scratch)"},
    {"select", py_select, METH_VARARGS,
     "select(g, counter, in_ap, epsilon, selection, candidates) -> (index, reason)"},
    {"encode", py_encode, METH_VARARGS,
     "encode(profile, sender, slot, c_r, p, v, c, position_step) -> bytes, empty if not encodable"},
    {"frame_length", py_frame_length, METH_O,
     "frame_length(profile) -> bytes, 0 for an unknown profile"},
    {"decode", (PyCFunction)(void (*)(void))py_decode, METH_FASTCALL,
     "decode(data, position_step) -> (profile, sender, slot, c_r, p, v, c), or a negative error"},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef MODULE = {
    PyModuleDef_HEAD_INIT,
    .m_name = "dtsa_agent.core._kernel",
    .m_doc = "The compiled core of DTSA.",
    .m_size = -1,
    .m_methods = METHODS,
};

static const struct {
    const char *name;
    int value;
} CONSTANTS[] = {
    {"METRICS_CRASHED", METRICS_CRASHED},
    {"METRICS_ARRIVED", METRICS_ARRIVED},
    {"FRAME_MAX", FRAME_MAX},
    {"EXTENDED_LENGTH", EXTENDED_LENGTH},
    {"EXTENDED_HEAD", EXTENDED_HEAD},
    {"EXTENDED_SENDER_MAX", EXTENDED_SENDER_MAX},
    {"LEASE_OPEN", LEASE_OPEN},
    {"PRESENT_LEAVING", PRESENT_LEAVING},
};

static int add_constants(PyObject *module)
{
    for (size_t i = 0; i < sizeof CONSTANTS / sizeof *CONSTANTS; i++)
        if (PyModule_AddIntConstant(module, CONSTANTS[i].name, CONSTANTS[i].value) < 0) return -1;
    PyObject *names = names_dict();
    const int status = names ? PyModule_AddObjectRef(module, "NAMES", names) : -1;
    Py_XDECREF(names);
    return status;
}

PyMODINIT_FUNC PyInit__kernel(void)
{
    if (PyType_Ready(&SwarmType) < 0 || PyType_Ready(&MetricsType) < 0) return NULL;
    PyObject *module = PyModule_Create(&MODULE);
    if (!module) return NULL;
    if (PyModule_AddFunctions(module, avoider_methods) < 0 ||
        PyModule_AddFunctions(module, lease_methods) < 0 ||
        PyModule_AddObjectRef(module, "Swarm", (PyObject *)&SwarmType) < 0 ||
        PyModule_AddObjectRef(module, "Metrics", (PyObject *)&MetricsType) < 0 ||
        add_constants(module) < 0) {
        Py_DECREF(module);
        return NULL;
    }
    return module;
}
