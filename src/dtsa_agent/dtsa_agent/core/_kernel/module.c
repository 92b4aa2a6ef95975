/* The binding of libdtsa: what Python can call; _kernel.pyi says what each function does.
 *
 * What crosses are whole numbers, doubles and bytes, and the images of structures that live on (a
 * swarm, metrics): core/binding.py makes them, and their arrays are NumPy's, borrowed by address,
 * so that both sides look at the same memory. All in the limited API: one compiled module serves
 * Python 3.10 and all later versions. */
#define Py_LIMITED_API 0x030A0000
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <string.h>

#include "avoider/avoider.h"
#include "metrics.h"
#include "swarm.h"

/* ---- arguments: a function says by letters what it takes ---- */

/* q whole number, d double, y bytes, o any object; s swarm, m metrics; of the swarm: i local index,
 * k control instant, K the same but not the last. Bytes that are arrays: 3 three doubles; of the
 * same n: P (3, n) doubles, G n values of eight bytes, B n bytes. z, g, t: y, G, s or None, for
 * which `at` is NULL. */
typedef struct value {
    int64_t whole;
    double real;
    void *at;
    Py_ssize_t bytes;
    Py_ssize_t n; /* in the first argument */
} value;

enum { ARGUMENTS_MAX = 10, THREE = 3 * sizeof(double) };

typedef struct function {
    const char *name, *takes;
    PyObject *(*run)(const value *v);
    PyMethodDef def; /* filled in by add_functions */
} function;

static PyObject *none(void) { Py_RETURN_NONE; }

static PyObject *refused(const char *what, int64_t got)
{
    return PyErr_Format(PyExc_ValueError, "%s: got %lld", what, (long long)got);
}

static int within(const char *what, int64_t got, int64_t end)
{
    return (got >= 0 && got < end) || refused(what, got);
}

static int take_whole(value *v, int i, char kind, PyObject *object)
{
    const swarm *s = v->at;
    const int64_t got = v[i].whole = PyLong_AsLongLong(object);
    if (got == -1 && PyErr_Occurred()) return 0;
    if (kind == 'i') return within("local index", got, s->local_count);
    return kind == 'q' || within("step", got, s->config.steps + (kind == 'k'));
}

static int take_bytes(value *v, int i, char kind, PyObject *object)
{
    const Py_ssize_t size = kind == 'B' ? 1 : kind == 'G' || kind == 'g' ? 8 : THREE;
    char *at;
    if (PyBytes_AsStringAndSize(object, &at, &v[i].bytes) < 0) return 0;
    v[i].at = at;
    if (kind == 'y' || kind == 'z') return 1;
    if (kind != '3' && v->n < 0) v->n = v[i].bytes / size;
    if (v[i].bytes == size * (kind == '3' ? 1 : v->n)) return 1;
    PyErr_Format(PyExc_ValueError, "argument %d: %zd bytes", i + 1, v[i].bytes);
    return 0;
}

static int take(value *v, int i, char kind, PyObject *object)
{
    const int none = object == Py_None && (kind == 'z' || kind == 'g' || kind == 't');
    v[i].at = NULL;
    switch (none ? 'n' : kind) {
    case 'n':
        return 1;
    case 'q':
    case 'i':
    case 'k':
    case 'K':
        return take_whole(v, i, kind, object);
    case 'd':
        v[i].real = PyFloat_AsDouble(object);
        return v[i].real != -1.0 || !PyErr_Occurred();
    case 'o':
        v[i].at = object;
        return 1;
    case 's':
    case 't':
    case 'm':
        v[i].at = PyCapsule_GetPointer(object, kind == 'm' ? "metrics" : "swarm");
        return v[i].at != NULL;
    default:
        return take_bytes(v, i, kind, object);
    }
}

static PyObject *run(PyObject *self, PyObject *const *args, Py_ssize_t count)
{
    const function *f = PyCapsule_GetPointer(self, NULL);
    value v[ARGUMENTS_MAX];
    v->n = -1;
    if (count != (Py_ssize_t)strlen(f->takes))
        return PyErr_Format(PyExc_TypeError, "%s: %zd arguments", f->name, count);
    for (int i = 0; i < count; i++)
        if (!take(v, i, f->takes[i], args[i])) return NULL;
    return f->run(v);
}

/* ---- swarms and metrics: capsules that keep the arrays they borrow ---- */

static void drop(PyObject *capsule)
{
    void *object = PyCapsule_GetPointer(capsule, PyCapsule_GetName(capsule));
    if (PyCapsule_IsValid(capsule, "swarm")) swarm_close(object);
    Py_XDECREF(PyCapsule_GetContext(capsule));
    PyMem_Free(object);
}

/* A structure of `size` bytes, of which Python filled in the first. */
static PyObject *keep(const char *kind, const value *v, size_t filled, size_t size)
{
    if (v->bytes != (Py_ssize_t)filled) return refused("image", v->bytes);
    void *object = PyMem_Calloc(1, size);
    PyObject *capsule = object ? PyCapsule_New(object, kind, drop) : PyErr_NoMemory();
    if (!capsule) return PyMem_Free(object), NULL;
    memcpy(object, v->at, filled);
    PyCapsule_SetContext(capsule, Py_NewRef(v[1].at));
    return capsule;
}

static PyObject *new_swarm(const value *v)
{
    PyObject *capsule = keep("swarm", v, offsetof(swarm, tables), sizeof(swarm));
    const char *fault = capsule ? swarm_open(PyCapsule_GetPointer(capsule, "swarm")) : NULL;
    if (!fault) return capsule;
    Py_DECREF(capsule);
    return PyErr_Format(PyExc_ValueError, "%s: out of range", fault);
}

static PyObject *new_metrics(const value *v)
{
    return keep("metrics", v, sizeof(metrics), sizeof(metrics));
}

static PyObject *update(const value *v)
{
    metrics *m = v->at;
    swarm *tables = v[3].at;
    const Py_ssize_t step = m->n * (Py_ssize_t)THREE;
    if (step < 1 || v[2].bytes < step || v[2].bytes % step) return refused("track", v[2].bytes);
    if (tables && tables->config.agents != m->n) return refused("tables", tables->config.agents);
    return PyLong_FromLong(
        metrics_update(m, v[1].whole, (int)(v[2].bytes / step), v[2].at, tables));
}

/* ---- a swarm's slot ---- */

static PyObject *decide(const value *v) { return swarm_decide(v->at, v[1].whole), none(); }
static PyObject *fly(const value *v) { return swarm_fly(v->at, v[1].whole), none(); }
static PyObject *move(const value *v) { return swarm_move(v->at, (int)v[1].whole), none(); }
static PyObject *end(const value *v) { return swarm_end(v->at, v[1].whole), none(); }
static PyObject *reset(const value *v) { return swarm_reset(v->at), none(); }

static PyObject *emit(const value *v)
{
    swarm *s = v->at;
    swarm_emit(s, v[1].whole);
    PyObject *senders = PyTuple_New(s->sender_count);
    for (int i = 0; senders && i < s->sender_count; i++)
        PyTuple_SetItem(senders, i, PyLong_FromLong(s->senders[i]));
    return senders;
}

static PyObject *begin(const value *v)
{
    swarm_decide(v->at, v[1].whole);
    return emit(v);
}

static PyObject *steer(const value *v)
{
    return swarm_steer(v->at, v[1].whole, (int)v[2].whole, v[3].whole != 0), none();
}

static PyObject *estimate(const value *v)
{
    swarm *s = v->at;
    for (int t = 0; t < s->table_count; t++) swarm_estimate(s, t, v[1].whole, (int)v[2].whole);
    return none();
}

static PyObject *hear(const value *v)
{
    swarm *s = v->at;
    if (v[3].at && v[3].bytes != s->table_count) return refused("mask", v[3].bytes);
    return PyBool_FromLong(swarm_hear(s, v[1].whole, v[2].at, v[2].bytes, v[3].at));
}

static PyObject *frame(const value *v)
{
    const swarm *s = v->at;
    const int64_t l = v[1].whole;
    return PyBytes_FromStringAndSize((const char *)s->frames + l * DTSA_FRAME_MAX, s->frame_len[l]);
}

static PyObject *restart(const value *v)
{
    const swarm *s = v->at;
    return s->shared ? refused("shared", 1) : (swarm_restart(v->at, (int)v[1].whole), none());
}

static PyObject *lease_status(const value *v)
{
    const swarm *s = v->at;
    if (s->config.policy != DTSA_POLICY_LEASE) return refused("policy", s->config.policy);
    const dtsa_status t = dtsa_agent_status(&s->agents[v[1].whole]);
    return Py_BuildValue("(NNLiii)", PyBool_FromLong(t.probation), PyBool_FromLong(t.deaf),
                         (long long)t.woke, t.alive, t.absent, t.silent_slots);
}

static PyObject *policy_bytes(const value *v)
{
    const dtsa_config config = {.policy = (int)v[0].whole,
                                .agents = (int)v[1].whole,
                                .lease = {.anchor_every = (int)v[2].whole}};
    return PyLong_FromSize_t(swarm_policy_bytes(&config));
}

/* ---- frames: records are the structures of frame.h as bytes ---- */

static PyObject *encode(const value *v)
{
    uint8_t out[DTSA_FRAME_MAX];
    const double step = v[1].real;
    int length = 0;
    if (!(step > 0.0)) return refused("position_step", 0);
    if (v->bytes == sizeof(extended_frame))
        length = extended_encode(v->at, step, out);
    else if (v->bytes == sizeof(dtsa_frame))
        length = frame_encode(v->at, step, out);
    else
        return refused("record", v->bytes);
    return PyBytes_FromStringAndSize((const char *)out, length);
}

static PyObject *decode(const value *v)
{
    extended_frame record = {.c_s = 0};
    const double step = v[1].real;
    const int extended = v[2].whole != 0;
    if (!(step > 0.0)) return refused("position_step", 0);
    const int fault = extended ? extended_decode(v->at, v->bytes, step, &record)
                               : frame_decode(v->at, v->bytes, step, &record.own);
    const size_t size = extended ? sizeof record : sizeof record.own;
    return fault ? PyLong_FromLong(fault)
                 : PyBytes_FromStringAndSize((const char *)&record, (Py_ssize_t)size);
}

/* ---- parts that need no swarm ---- */

static PyObject *priority(const value *v)
{
    PyObject *g = PyBytes_FromStringAndSize(NULL, v->n * (Py_ssize_t)sizeof(double));
    double *scratch = PyMem_Calloc(7 * (size_t)v->n, sizeof(double));
    if (g && scratch)
        priority_values((int)v->n, v[2].real, v->at, v[1].at, (void *)PyBytes_AsString(g), scratch);
    PyMem_Free(scratch);
    return scratch ? g : PyErr_NoMemory();
}

static PyObject *select_one(const value *v)
{
    PyObject *candidates = PyBytes_FromStringAndSize(NULL, v->n);
    int reason;
    if (!candidates) return NULL;
    uint8_t *at = memset(PyBytes_AsString(candidates), 0, (size_t)v->n);
    const int k =
        select_sender((int)v->n, (int)v[4].whole, v[3].real, v->at, v[1].at, v[2].at, at, &reason);
    return Py_BuildValue("(iiN)", k, reason, candidates);
}

static PyObject *avoid(const value *v)
{
    double out[3], *scratch;
    if (!within("kind", v->whole, DTSA_AVOID_COUNT)) return NULL;
    if (v[1].bytes != sizeof(dtsa_avoid_params)) return refused("params", v[1].bytes);
    scratch = PyMem_Calloc((size_t)avoid_scratch_doubles((int)v->n), sizeof(double));
    if (!scratch) return PyErr_NoMemory();
    avoid_command((int)v->whole, v[1].at, (int)v->n, (int)v[2].whole, v[3].at, v[4].at, v[5].at,
                  v[6].at, v[7].at, v[8].at, scratch, out);
    PyMem_Free(scratch);
    return PyBytes_FromStringAndSize((const char *)out, THREE);
}

static PyObject *vehicle(const value *v)
{
    const vehicle_params params = {v[0].real, v[1].real};
    const size_t bytes = (size_t)v->n * THREE;
    PyObject *moved = PyBytes_FromStringAndSize(NULL, 2 * (Py_ssize_t)bytes);
    if (!moved) return NULL;
    char *at = PyBytes_AsString(moved);
    memcpy(at, v[3].at, bytes);
    memcpy(at + bytes, v[4].at, bytes);
    vehicle_step_all(&params, v[2].real, (int)v->n, (void *)at, (void *)(at + bytes), v[5].at);
    return moved;
}

static PyObject *vector_level(const value *v)
{
    return PyLong_FromLong(avoid_vector_level((int)v->whole));
}

static PyObject *names(const value *v)
{
    const dtsa_name_list *list = dtsa_names((int)v->whole);
    PyObject *all = PyTuple_New(list ? list->count + 1 : 0);
    for (int k = 0; list && all && k <= list->count; k++)
        PyTuple_SetItem(all, k, PyUnicode_FromString(k ? list->names[k - 1] : list->kind));
    return all;
}

/* ---- the module ---- */

/* clang-format off */
static function FUNCTIONS[] = {
    {"swarm", "yo", new_swarm}, {"decide", "sq", decide}, {"emit", "sq", emit},
    {"begin", "sq", begin}, {"fly", "sq", fly}, {"steer", "sqkq", steer}, {"move", "sK", move},
    {"estimate", "sqk", estimate}, {"hear", "sqyz", hear}, {"end", "sq", end},
    {"frame", "si", frame}, {"restart", "si", restart}, {"reset", "s", reset},
    {"lease_status", "si", lease_status}, {"policy_bytes", "qqq", policy_bytes},
    {"metrics", "yo", new_metrics}, {"update", "mqyt", update},
    {"encode", "yd", encode}, {"decode", "ydq", decode},
    {"priority", "PPd", priority}, {"select", "GGBdq", select_one},
    {"avoid_command", "qyq333PPg", avoid}, {"vehicle_step", "dddPPP", vehicle},
    {"vector_level", "q", vector_level}, {"names", "q", names}, {0},
};

static const struct {
    const char *name;
    int value;
} CONSTANTS[] = {
    {"VERSION", DTSA_VERSION}, {"FRAME_MAX", DTSA_FRAME_MAX}, {"FRAME_RECORD", sizeof(dtsa_frame)},
    {"EXTENDED_RECORD", sizeof(extended_frame)}, {"SWARM_IMAGE", offsetof(swarm, tables)},
    {"METRICS_IMAGE", sizeof(metrics)},
};
/* clang-format on */

static int fill_module(PyObject *module)
{
    for (size_t i = 0; i < sizeof CONSTANTS / sizeof *CONSTANTS; i++)
        if (PyModule_AddIntConstant(module, CONSTANTS[i].name, CONSTANTS[i].value) < 0) return -1;
    for (function *f = FUNCTIONS; f->name; f++) {
        f->def = (PyMethodDef){f->name, (PyCFunction)(void (*)(void))run, METH_FASTCALL, NULL};
        PyObject *row = PyCapsule_New(f, NULL, NULL);
        PyObject *made = row ? PyCFunction_New(&f->def, row) : NULL;
        const int status = made ? PyModule_AddObjectRef(module, f->name, made) : -1;
        Py_XDECREF(made);
        Py_XDECREF(row);
        if (status < 0) return -1;
    }
    return 0;
}

PyMODINIT_FUNC PyInit__kernel(void)
{
    static PyModuleDef_Slot slots[] = {{Py_mod_exec, fill_module}, {0, NULL}};
    static struct PyModuleDef def = {PyModuleDef_HEAD_INIT, .m_name = "dtsa_agent.core._kernel",
                                     .m_slots = slots};
    return PyModuleDef_Init(&def);
}
