/* Kernel module: what Python can call; _kernel.pyi says what each does. */
#include "binding.h"

static PyObject *none(void) { Py_RETURN_NONE; }

static PyObject *refused(const char *what, int64_t got)
{
    return PyErr_Format(PyExc_ValueError, "%s: got %lld", what, (long long)got);
}

/* ---- swarms ---- */

static PyObject *new_swarm(const call *c) { return make_swarm(c->at[0], c->at[1]); }

static PyObject *senders(const swarm *s)
{
    PyObject *tuple = PyTuple_New(s->sender_count);
    for (int i = 0; tuple && i < s->sender_count; i++)
        PyTuple_SET_ITEM(tuple, i, PyLong_FromLong(s->senders[i]));
    return tuple;
}

static PyObject *decide(const call *c) { return swarm_decide(c->at[0], c->whole[1]), none(); }
static PyObject *fly(const call *c) { return swarm_fly(c->at[0], c->whole[1]), none(); }
static PyObject *end(const call *c) { return swarm_end(c->at[0], c->whole[1]), none(); }
static PyObject *reset(const call *c) { return swarm_reset(c->at[0]), none(); }

static PyObject *emit(const call *c)
{
    swarm_emit(c->at[0], c->whole[1]);
    return senders(c->at[0]);
}

static PyObject *begin(const call *c)
{
    swarm_decide(c->at[0], c->whole[1]);
    return emit(c);
}

static int within(const char *name, int64_t value, int64_t end)
{
    if (value < 0 || value >= end) refused(name, value);
    return value >= 0 && value < end;
}

static PyObject *steer(const call *c)
{
    swarm *s = c->at[0];
    if (!within("step", c->whole[2], s->config.steps + 1)) return NULL;
    return swarm_steer(s, c->whole[1], (int)c->whole[2], c->whole[3] != 0), none();
}

static PyObject *move(const call *c)
{
    swarm *s = c->at[0];
    if (!within("step", c->whole[1], s->config.steps)) return NULL;
    return swarm_move(s, (int)c->whole[1]), none();
}

static PyObject *estimate(const call *c)
{
    swarm *s = c->at[0];
    if (!within("step", c->whole[2], s->config.steps + 1)) return NULL;
    for (int v = 0; v < s->table_count; v++) swarm_estimate(s, v, c->whole[1], (int)c->whole[2]);
    return none();
}

static PyObject *hear(const call *c)
{
    swarm *s = c->at[0];
    if (c->at[3] && c->items[3] != s->table_count) return refused("mask", c->items[3]);
    return PyBool_FromLong(swarm_hear(s, c->whole[1], c->at[2], c->items[2], c->at[3]));
}

static PyObject *frame(const call *c)
{
    const swarm *s = c->at[0];
    const int64_t l = c->whole[1];
    if (!within("local index", l, s->local_count)) return NULL;
    return PyBytes_FromStringAndSize((const char *)s->frames + l * DTSA_FRAME_MAX, s->frame_len[l]);
}

static PyObject *restart(const call *c)
{
    swarm *s = c->at[0];
    if (!within("local index", c->whole[1], s->shared ? 0 : s->local_count)) return NULL;
    return swarm_restart(s, (int)c->whole[1]), none();
}

static PyObject *lease_status(const call *c)
{
    const swarm *s = c->at[0];
    const int leases = s->config.policy == DTSA_POLICY_LEASE;
    if (!within("local index", c->whole[1], leases ? s->local_count : 0)) return NULL;
    const dtsa_status t = dtsa_agent_status(&s->agents[c->whole[1]]);
    return Py_BuildValue("(NNLiii)", PyBool_FromLong(t.probation), PyBool_FromLong(t.deaf),
                         (long long)t.woke, t.alive, t.absent, t.silent_slots);
}

/* ---- metrics ---- */

static PyObject *new_metrics(const call *c) { return make_metrics(c->at[0], c->at[1]); }

static PyObject *update(const call *c)
{
    metrics *m = c->at[0];
    swarm *tables = c->at[3];
    const Py_ssize_t steps = c->items[2] / (3 * m->n);
    if (steps < 1 || c->items[2] % (3 * m->n)) return refused("track", c->items[2]);
    if (tables && tables->config.agents != m->n) return refused("tables", tables->config.agents);
    return PyLong_FromLong(metrics_update(m, c->whole[1], (int)steps, c->at[2], tables));
}

/* ---- frames: records are the structures of frame.h as bytes ---- */

static PyObject *encode(const call *c)
{
    uint8_t out[DTSA_FRAME_MAX];
    int length = 0;
    if (!(c->real[1] > 0.0)) return refused("position_step", 0);
    if (c->items[0] == sizeof(dtsa_frame))
        length = frame_encode(c->at[0], c->real[1], out);
    else if (c->items[0] == sizeof(extended_frame))
        length = extended_encode(c->at[0], c->real[1], out);
    else
        return refused("record", c->items[0]);
    return PyBytes_FromStringAndSize((const char *)out, length);
}

static PyObject *decode(const call *c)
{
    if (!(c->real[1] > 0.0)) return refused("position_step", 0);
    if (c->items[2] == sizeof(dtsa_frame))
        return PyLong_FromLong(frame_decode(c->at[0], c->items[0], c->real[1], c->at[2]));
    if (c->items[2] == sizeof(extended_frame))
        return PyLong_FromLong(extended_decode(c->at[0], c->items[0], c->real[1], c->at[2]));
    return refused("record", c->items[2]);
}

static PyObject *length(const call *c) { return PyLong_FromLong(frame_length((int)c->whole[0])); }

static PyObject *lease_bytes(const call *c)
{
    const dtsa_config config = {.agents = (int)c->whole[0],
                                .policy = DTSA_POLICY_LEASE,
                                .lease = {.anchor_every = (int)c->whole[1]}};
    return PyLong_FromSize_t(swarm_policy_bytes(&config));
}

/* ---- priorities, avoiders, vehicles ---- */

static PyObject *priority(const call *c)
{
    priority_values((int)c->n, c->real[2], c->at[0], c->at[1], c->at[3], c->at[4]);
    return none();
}

static PyObject *select_one(const call *c)
{
    int reason;
    const int k = select_sender((int)c->n, (int)c->whole[4], c->real[3], c->at[0], c->at[1],
                                c->at[2], c->at[5], &reason);
    return Py_BuildValue("(ii)", k, reason);
}

/* Commands of some agents, each with its own true state (planes of `count`), from one table of beliefs. */
static PyObject *avoid(const call *c, int first, int count, void *const *at)
{
    const int64_t kind = c->whole[0];
    if (kind < 0 || kind >= DTSA_AVOID_COUNT) return refused("kind", kind);
    double *scratch = PyMem_Malloc(sizeof(double) * (size_t)avoid_scratch_doubles((int)c->n));
    if (!scratch) return PyErr_NoMemory();
    for (int k = 0; k < count; k++) {
        double own[3][3], out[3];
        for (int i = 0; i < 9; i++) own[i / 3][i % 3] = ((double *)at[i / 3])[i % 3 * count + k];
        avoid_command((int)kind, &c->params, (int)c->n, first + k, own[0], own[1], own[2], at[3],
                      at[4], at[5], scratch, out);
        for (int axis = 0; axis < 3; axis++) ((double *)at[6])[axis * count + k] = out[axis];
    }
    PyMem_Free(scratch);
    return none();
}

static PyObject *avoid_one(const call *c) { return avoid(c, (int)c->whole[2], 1, c->at + 3); }
static PyObject *avoid_all(const call *c) { return avoid(c, 0, (int)c->n, c->at + 2); }

static PyObject *vehicle(const call *c)
{
    const vehicle_params params = {c->real[0], c->real[1]};
    vehicle_step_all(&params, c->real[2], (int)c->n, c->at[3], c->at[4], c->at[5]);
    return none();
}

static PyObject *vector_level(const call *c)
{
    return PyLong_FromLong(avoid_vector_level(c->given ? (int)c->whole[0] : -1));
}

/* ---- the module ---- */

#define SWARM {"swarm", 'S', 0, 0, 0, 0}
#define WHOLE(name) {name, 'q', 0, 0, 0, 0}
#define REAL(name) {name, 'd', 0, 0, 0, 0}
#define OBJECT(name) {name, 'O', 0, 0, 0, 0}
#define READ(name, size, times) {name, 'r', size, times, 0, 0}
#define WRITE(name, size, times) {name, 'w', size, times, 0, 0}
#define THREE(name, kind) {name, kind, 8, 0, 3, 0}
#define AGES {"age_s", 'r', 8, 1, 0, 1}
/* clang-format off */
static const function FUNCTIONS[] = {
    {"swarm", new_swarm, 2, {OBJECT("parameters"), OBJECT("arrays")}},
    {"decide", decide, 2, {SWARM, WHOLE("slot")}},
    {"emit", emit, 2, {SWARM, WHOLE("slot")}},
    {"begin", begin, 2, {SWARM, WHOLE("slot")}},
    {"fly", fly, 2, {SWARM, WHOLE("slot")}},
    {"end", end, 2, {SWARM, WHOLE("slot")}},
    {"reset", reset, 1, {SWARM}},
    {"steer", steer, 4, {SWARM, WHOLE("slot"), WHOLE("step"), WHOLE("estimate")}},
    {"move", move, 2, {SWARM, WHOLE("step")}},
    {"estimate", estimate, 3, {SWARM, WHOLE("slot"), WHOLE("step")}},
    {"hear", hear, 4, {SWARM, WHOLE("slot"), READ("data", 1, 0), {"mask", 'r', 1, 0, 0, 1}}},
    {"frame", frame, 2, {SWARM, WHOLE("index")}},
    {"restart", restart, 2, {SWARM, WHOLE("index")}},
    {"lease_status", lease_status, 2, {SWARM, WHOLE("index")}},
    {"metrics", new_metrics, 2, {OBJECT("values"), OBJECT("arrays")}},
    {"update", update, 4, {{"metrics", 'M', 0, 0, 0, 0}, WHOLE("slot"), READ("track", 8, 0), {"tables", 'S', 0, 0, 0, 1}}},
    {"encode", encode, 2, {READ("record", 1, 0), REAL("position_step")}},
    {"decode", decode, 3, {READ("data", 1, 0), REAL("position_step"), WRITE("record", 1, 0)}},
    {"frame_length", length, 1, {WHOLE("profile")}},
    {"lease_state_bytes", lease_bytes, 2, {WHOLE("agents"), WHOLE("anchor_every")}},
    {"priority", priority, 5, {READ("position", 8, 3), READ("velocity", 8, 3), REAL("slot_s"), WRITE("out", 8, 1), WRITE("scratch", 8, 7)}},
    {"select", select_one, 6, {READ("g", 8, 1), {"counter", 'h', 8, 1, 0, 0}, READ("in_ap", 1, 1), REAL("epsilon"), WHOLE("selection"), WRITE("candidates", 1, 1)}},
    {"avoid_command", avoid_one, 10, {WHOLE("kind"), {"params", 'P', 0, 0, 0, 0}, WHOLE("self"), THREE("position", 'r'), THREE("velocity", 'r'), THREE("goal", 'r'), READ("others_p", 8, 3), READ("others_v", 8, 3), AGES, THREE("command", 'w')}},
    {"avoid_all", avoid_all, 9, {WHOLE("kind"), {"params", 'P', 0, 0, 0, 0}, READ("position", 8, 3), READ("velocity", 8, 3), READ("goal", 8, 3), READ("others_p", 8, 3), READ("others_v", 8, 3), AGES, WRITE("command", 8, 3)}},
    {"vehicle_step", vehicle, 6, {REAL("tau"), REAL("a_max"), REAL("dt"), WRITE("position", 8, 3), WRITE("velocity", 8, 3), READ("command", 8, 3)}},
    {"vector_level", vector_level, 0, {WHOLE("level")}},
    {0},
};

static const struct {
    const char *name;
    int value;
} CONSTANTS[] = {
    {"METRICS_CRASHED", METRICS_CRASHED}, {"METRICS_ARRIVED", METRICS_ARRIVED}, {"FRAME_MAX", DTSA_FRAME_MAX},
    {"EXTENDED_LENGTH", EXTENDED_LENGTH}, {"EXTENDED_HEAD", EXTENDED_HEAD}, {"LEASE_OPEN", LEASE_OPEN},
    {"EXTENDED_SENDER_MAX", DTSA_EXTENDED_AGENTS_MAX}, {"PRESENT_LEAVING", PRESENT_LEAVING},
    {"FRAME_RECORD", sizeof(dtsa_frame)}, {"EXTENDED_RECORD", sizeof(extended_frame)}, {"VERSION", DTSA_VERSION},
};
/* clang-format on */

static int add_names(PyObject *module)
{
    PyObject *dict = PyDict_New();
    for (int i = 0; dict && dtsa_names(i); i++) {
        const dtsa_name_list *list = dtsa_names(i);
        PyObject *tuple = PyTuple_New(list->count);
        for (int k = 0; tuple && k < list->count; k++)
            PyTuple_SET_ITEM(tuple, k, PyUnicode_FromString(list->names[k]));
        if (!tuple || PyDict_SetItemString(dict, list->kind, tuple) < 0) return -1;
        Py_DECREF(tuple);
    }
    const int status = dict ? PyModule_AddObjectRef(module, "NAMES", dict) : -1;
    Py_XDECREF(dict);
    return status;
}

static int fill_module(PyObject *module)
{
    for (size_t i = 0; i < sizeof CONSTANTS / sizeof *CONSTANTS; i++)
        if (PyModule_AddIntConstant(module, CONSTANTS[i].name, CONSTANTS[i].value) < 0) return -1;
    return add_names(module) < 0 || add_functions(module, FUNCTIONS) < 0 ? -1 : 0;
}

PyMODINIT_FUNC PyInit__kernel(void)
{
    static PyModuleDef_Slot slots[] = {{Py_mod_exec, fill_module}, {0, NULL}};
    static struct PyModuleDef def = {PyModuleDef_HEAD_INIT, .m_name = "dtsa_agent.core._kernel",
                                     .m_slots = slots};
    return PyModuleDef_Init(&def);
}
