/* Functions of C called from Python: their arguments are checked and borrowed by tables. */
#include "binding.h"

static int take_array(call *c, const arg *a, PyObject *object, int i)
{
    Py_buffer *b = &c->buffers[c->borrowed];
    const int flags = PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | (a->kind == 'w' ? PyBUF_WRITABLE : 0);
    if (PyObject_GetBuffer(object, b, flags) < 0) return -1;
    c->borrowed++;
    if (b->itemsize != a->size || (a->size == 8 && (a->kind == 'h') != (b->format[0] != 'd'))) {
        PyErr_Format(PyExc_ValueError, "%s: wrong type of values", a->name);
        return -1;
    }
    c->at[i] = b->buf;
    c->items[i] = b->len / a->size;
    if (a->times && c->n < 0 && c->items[i] % a->times == 0) c->n = c->items[i] / a->times;
    const int any = !a->times && !a->fixed;
    if (any || c->items[i] == a->fixed + a->times * c->n) return 0;
    PyErr_Format(PyExc_ValueError, "%s: wrong number of values: %zd", a->name, c->items[i]);
    return -1;
}

static int take(call *c, const arg *a, PyObject *object, int i)
{
    if (a->none && object == Py_None) return 0;
    switch (a->kind) {
    case 'q':
        c->whole[i] = PyLong_AsLongLong(object);
        return c->whole[i] == -1 && PyErr_Occurred() ? -1 : 0;
    case 'd':
        c->real[i] = PyFloat_AsDouble(object);
        return c->real[i] == -1.0 && PyErr_Occurred() ? -1 : 0;
    case 'P':
        return fill_scalars(&c->params, AVOID_FIELDS, object);
    case 'O':
        c->at[i] = object;
        return 0;
    case 'S':
    case 'M':
        c->at[i] = PyCapsule_GetPointer(object, a->kind == 'S' ? "swarm" : "metrics");
        return c->at[i] ? 0 : -1;
    default:
        return take_array(c, a, object, i);
    }
}

static PyObject *run(PyObject *self, PyObject *const *args, Py_ssize_t count)
{
    const function *f = PyCapsule_GetPointer(self, NULL);
    call c;
    int most = 0, failed = 0;
    while (f->args[most].name) most++;
    if (count < f->least || count > most)
        return PyErr_Format(PyExc_TypeError, "%s: %zd arguments; allowed: %d to %d", f->name, count,
                            f->least, most);
    c.given = count;
    c.n = -1;
    c.borrowed = 0;
    for (int i = 0; i < most && !failed; i++) {
        c.at[i] = NULL;
        c.whole[i] = 0;
        failed = i < count && take(&c, &f->args[i], args[i], i) < 0;
    }
    PyObject *result = failed ? NULL : f->run(&c);
    while (c.borrowed > 0) PyBuffer_Release(&c.buffers[--c.borrowed]);
    return result;
}

int add_functions(PyObject *module, const function *functions)
{
    static PyMethodDef defs[40];
    for (int i = 0; functions[i].name; i++) {
        defs[i] =
            (PyMethodDef){functions[i].name, (PyCFunction)(void (*)(void))run, METH_FASTCALL, NULL};
        PyObject *row = PyCapsule_New((void *)&functions[i], NULL, NULL);
        PyObject *made = row ? PyCFunction_New(&defs[i], row) : NULL;
        Py_XDECREF(row);
        const int status = made ? PyModule_AddObjectRef(module, functions[i].name, made) : -1;
        Py_XDECREF(made);
        if (status < 0) return -1;
    }
    return 0;
}
