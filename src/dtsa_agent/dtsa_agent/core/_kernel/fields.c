/* Structures of C filled from dicts of Python, by tables of their fields. */
#include "binding.h"

#define FIELD(type, path, name, kind, size) {name, offsetof(type, path), kind, size}
#define SCALAR(name, kind) FIELD(swarm, config.name, #name, kind, 0)
#define LEASE(name, kind) FIELD(swarm, config.lease.name, #name, kind, 0)
#define ARRAY(name, kind, size) FIELD(swarm, name, #name, kind, size)
#define PARAM(name) FIELD(dtsa_avoid_params, name, #name, 'd', 0)
#define SUMS(name, kind, size) FIELD(metrics, name, #name, kind, size)
/* clang-format off */
static const field SWARM_FIELDS[] = {
    SCALAR(agents, 'i'), SCALAR(slot_s, 'd'), SCALAR(steps, 'i'), SCALAR(policy, 'i'), SCALAR(estimator, 'i'),
    SCALAR(avoider, 'i'), SCALAR(selection, 'i'), SCALAR(profile, 'i'), SCALAR(epsilon, 'd'), SCALAR(age_cap, 'd'),
    SCALAR(boot_round, 'i'), SCALAR(return_every, 'i'), SCALAR(r_min, 'd'), SCALAR(c_r, 'i'),
    SCALAR(targets_known, 'i'), SCALAR(gossip, 'i'), SCALAR(position_step, 'd'), SCALAR(key, 'q'),
    SCALAR(decay_len, 'i'), LEASE(anchor_every, 'i'), LEASE(open_every, 'i'), LEASE(adoption, 'i'),
    LEASE(depth_rate, 'd'), LEASE(share, 'd'), LEASE(patience, 'q'),
    FIELD(swarm, local_count, "local_count", 'i', 0), FIELD(swarm, table_count, "table_count", 'i', 0),
    FIELD(swarm, shared, "shared", 'i', 0), FIELD(swarm, vehicle.tau, "tau", 'd', 0),
    FIELD(swarm, vehicle.a_max, "a_max", 'd', 0), FIELD(swarm, config.start, "start", 'N', 8),
    FIELD(swarm, config.target, "target", 'N', 8), FIELD(swarm, config.decay, "decay", 'd', 8),
    ARRAY(local, 'l', 4), ARRAY(observer, 'v', 4), ARRAY(sent_p, 'T', 8), ARRAY(sent_v, 'T', 8),
    ARRAY(sent_c, 'T', 8), ARRAY(sent_slot, 't', 8), ARRAY(last, 't', 8), ARRAY(in_ap, 't', 1),
    ARRAY(entry_hash, 't', 4), ARRAY(table_hash, 'v', 4), ARRAY(est_p, 'T', 8), ARRAY(est_v, 'T', 8),
    ARRAY(g, 't', 8), ARRAY(h, 't', 8), ARRAY(pos, 'L', 8), ARRAY(vel, 'L', 8), ARRAY(cmd, 'L', 8),
    ARRAY(goal, 'L', 8), ARRAY(track, 'S', 8), ARRAY(active, 'l', 1), ARRAY(final, 'l', 1),
    ARRAY(present, 'l', 1), ARRAY(chosen, 'l', 2), ARRAY(reason, 'l', 1), ARRAY(digest, 'l', 4),
    ARRAY(score, 'l', 8), ARRAY(sends, 'l', 1), ARRAY(frame_len, 'l', 1), ARRAY(frames, 'F', 1),
    ARRAY(lease_state, 'e', 1), ARRAY(rejects, '2', 8), {0},
};

static const field METRICS_FIELDS[] = {
    SUMS(n, 'i', 0), SUMS(news_from, 'q', 0), SUMS(collision_m, 'd', 0), SUMS(r_min, 'd', 0),
    SUMS(path, 'n', 8), SUMS(last_position, 'N', 8), SUMS(target, 'N', 8), SUMS(moving, 'n', 1),
    SUMS(sums, '1', sizeof(metrics_sums)), {0},
};

const field AVOID_FIELDS[] = {
    PARAM(v_max), PARAM(gain), PARAM(radius), PARAM(horizon), PARAM(softness), PARAM(bias), PARAM(period),
    PARAM(influence), PARAM(strength), PARAM(core), PARAM(tangential), PARAM(margin_rate), PARAM(margin_max),
    PARAM(sidestep), PARAM(stretch_z), {0},
};
/* clang-format on */
_Static_assert(sizeof AVOID_FIELDS / sizeof *AVOID_FIELDS == DTSA_AVOID_PARAM_COUNT + 1, "names");

static Py_ssize_t swarm_items(const swarm *s, char kind)
{
    const Py_ssize_t n = s->config.agents, l = s->local_count, v = s->table_count;
    const struct {
        char kind;
        Py_ssize_t items;
    } sizes[] = {{'N', 3 * n},     {'d', 2 * s->config.decay_len},
                 {'l', l},         {'L', 3 * l},
                 {'v', v},         {'S', 3 * l * s->config.steps},
                 {'t', n * v},     {'F', l * DTSA_FRAME_MAX},
                 {'T', 3 * n * v}, {'e', l * (Py_ssize_t)swarm_policy_bytes(&s->config)}};
    for (size_t i = 0; i < sizeof sizes / sizeof *sizes; i++)
        if (sizes[i].kind == kind) return sizes[i].items;
    return 2;
}

static PyObject *item_of(PyObject *dict, const char *name)
{
    PyObject *item = PyDict_Check(dict) ? PyDict_GetItemString(dict, name) : NULL;
    if (!item) PyErr_Format(PyExc_KeyError, "%s is missing", name);
    return item;
}

int fill_scalars(void *object, const field *fields, PyObject *values)
{
    for (const field *f = fields; f->name; f++) {
        void *at = (char *)object + f->offset;
        if (f->size) continue;
        PyObject *item = item_of(values, f->name);
        if (!item) return -1;
        if (f->kind == 'd')
            *(double *)at = PyFloat_AsDouble(item);
        else if (f->kind == 'q')
            *(int64_t *)at = PyLong_AsLongLong(item);
        else
            *(int *)at = (int)PyLong_AsLong(item);
        if (PyErr_Occurred()) return -1;
    }
    return 0;
}

static int fill_arrays(holder *h, const field *fields, PyObject *arrays)
{
    const int n = h->of.m.n; /* of metrics */
    for (const field *f = fields; f->name; f++) {
        if (!f->size) continue;
        PyObject *item = item_of(arrays, f->name);
        Py_buffer *buffer = &h->arrays[h->count];
        if (!item || PyObject_GetBuffer(item, buffer, PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE) < 0)
            return -1;
        h->count++;
        const Py_ssize_t items = fields == SWARM_FIELDS ? swarm_items(&h->of.s, f->kind)
                                 : f->kind == '1'       ? 1
                                 : f->kind == 'n'       ? n
                                                        : 3 * n;
        if (buffer->len != items * (Py_ssize_t)f->size) {
            PyErr_Format(PyExc_ValueError, "%s: %zd bytes; allowed: %zd items of %zu", f->name,
                         buffer->len, items, f->size);
            return -1;
        }
        *(void **)((char *)&h->of + f->offset) = buffer->buf;
    }
    return 0;
}

static void drop(holder *h)
{
    while (h->count > 0) PyBuffer_Release(&h->arrays[--h->count]);
    PyMem_Free(h);
}

static void drop_metrics(PyObject *capsule) { drop(PyCapsule_GetPointer(capsule, "metrics")); }

static void drop_swarm(PyObject *capsule)
{
    holder *h = PyCapsule_GetPointer(capsule, "swarm");
    swarm_close(&h->of.s);
    drop(h);
}

PyObject *make_metrics(PyObject *values, PyObject *arrays)
{
    holder *h = PyMem_Calloc(1, sizeof *h);
    if (!h) return PyErr_NoMemory();
    if (fill_scalars(&h->of.m, METRICS_FIELDS, values) == 0 &&
        fill_arrays(h, METRICS_FIELDS, arrays) == 0)
        return PyCapsule_New(h, "metrics", drop_metrics);
    drop(h);
    return NULL;
}

PyObject *make_swarm(PyObject *values, PyObject *arrays)
{
    holder *h = PyMem_Calloc(1, sizeof *h);
    if (!h) return PyErr_NoMemory();
    swarm *s = &h->of.s;
    int ok = fill_scalars(s, SWARM_FIELDS, values) == 0 &&
             fill_scalars(&s->config.avoid, AVOID_FIELDS, values) == 0;
    const int sized = s->local_count >= 0 && s->table_count >= 0 && s->config.agents > 0;
    ok = ok && (!sized || fill_arrays(h, SWARM_FIELDS, arrays) == 0);
    const char *fault = ok && sized ? swarm_open(s) : "sizes";
    if (ok && !fault) return PyCapsule_New(h, "swarm", drop_swarm);
    if (ok) PyErr_Format(PyExc_ValueError, "%s: out of range", fault);
    swarm_close(s);
    drop(h);
    return NULL;
}
