#include "run.h"

#include <string.h>

/* ---- losses ---- */

DTSA_SIMD
static void advance_phases(int n, int first, const uint64_t *restrict words, uint64_t factor,
                           const uint64_t *restrict enter, const uint64_t *restrict keep,
                           const uint64_t *restrict share, uint8_t *restrict phase)
{
    for (int k = 0; k < n; k++) {
        const uint64_t word = words[k] * factor;
        const int kept = word < keep[k] && phase[k];
        phase[k] = first ? word < share[k] : word < enter[k] || kept;
    }
}

/* A slot begins, with or without a frame. */
static void advance_chains(sim_losses *o, int n, int64_t slot)
{
    for (int c = 0; c < o->chains; c++) {
        const long at = (long)c * n;
        advance_phases(n, slot == 0, o->state_words + (slot - o->first) * n,
                       o->chains == 1 ? 1 : o->state_factors[c], o->enter + at, o->keep + at,
                       o->share + at, o->phase + at);
    }
}

static void lose(const sim_losses *o, int n, int64_t slot, int sender, uint8_t *received)
{
    const uint64_t *words = o->words + (slot - o->first) * n, factor = o->factors[sender];
    const uint64_t *good = o->good + (long)sender * n, *bad = o->bad + (long)sender * n;
    const uint8_t *phase = o->chains ? o->phase + (o->chains == 1 ? 0 : (long)sender * n) : NULL;
    for (int k = 0; k < n; k++) {
        const int is_bad = phase && phase[k];
        received[k] = words[k] * factor >= (is_bad ? bad : good)[k];
    }
    received[sender] = 0;
}

/* ---- what happened ---- */

int sim_log_is_full(const sim_log *log, int n)
{
    return log->rows == log->capacity || log->frames + n > log->frame_capacity;
}

/* Appends a row of `size` bytes. */
static void append(void *array, int64_t row, const void *from, size_t size)
{
    if (array) memcpy((uint8_t *)array + row * (int64_t)size, from, size);
}

void sim_log_open(sim_log *log, const swarm *s)
{
    const size_t n = (size_t)s->config.agents, planes = 3 * n * sizeof(double);
    const int64_t row = log->rows, first = row * (int64_t)n;
    append(log->chosen, row, s->chosen, n * sizeof *s->chosen);
    append(log->reason, row, s->reason, n);
    append(log->digest, row, s->digest, n * sizeof *s->digest);
    append(log->score, row, s->score, n * sizeof *s->score);
    append(log->velocity, row, s->velocity, planes);
    append(log->command, row, s->command, planes);
    append(log->goal, row, s->goal, planes);
    memset(log->sent + first, 0, n);
    for (int i = 0; i < s->sender_count; i++) log->sent[first + s->senders[i]] = 1;
}

static void log_frame(sim_log *log, const swarm *s, int l, int outcome, const uint8_t *received)
{
    const int n = s->config.agents;
    uint8_t *row = log->received + log->frames * n;
    int count = 0;
    if (received)
        memcpy(row, received, (size_t)n);
    else
        memset(row, outcome == SIM_SUCCESS, (size_t)n);
    row[l] = 0;
    for (int k = 0; k < n; k++) count += row[k];
    (outcome == SIM_SUCCESS ? log->lost : log->collided)[log->rows * n + l] =
        (uint16_t)(n - 1 - count);
    if (log->data)
        memcpy(log->data + log->frames * log->frame_bytes, s->frames + (long)l * DTSA_FRAME_MAX,
               s->frame_length[l]);
    log->frames++;
}

static void log_knowledge(sim_log *log, swarm *s, int64_t slot)
{
    const size_t n = (size_t)s->config.agents, planes = 3 * n * sizeof(double);
    const int table = s->shared ? 0 : log->observer;
    const dtsa_table *t = &s->tables[table];
    swarm_estimate(s, table, slot, 0);
    append(log->heard_slot, log->rows, t->sent_slot, n * sizeof *t->sent_slot);
    append(log->heard_position, log->rows, t->sent_p, planes);
    append(log->estimate, log->rows, t->est_p, planes);
    append(log->in_ap, log->rows, t->in_ap, n);
}

void sim_log_close(sim_log *log, swarm *s, int64_t slot, int outcome, const uint8_t *received)
{
    const size_t n = (size_t)s->config.agents;
    const int64_t first = log->rows * (int64_t)n;
    log->outcome[log->rows] = (uint8_t)outcome;
    append(log->position, log->rows, s->track, 3 * n * sizeof(double) * (size_t)s->config.steps);
    memset(log->lost + first, 0, n * sizeof *log->lost);
    memset(log->collided + first, 0, n * sizeof *log->collided);
    for (int i = 0; i < s->sender_count; i++)
        log_frame(log, s, s->senders[i], outcome, received ? received + (long)i * (long)n : NULL);
    if (log->heard_slot) log_knowledge(log, s, slot + 1);
    log->rows++;
}

/* ---- flights ---- */

int dtsa_sim_run(sim_flight *f, int64_t slots)
{
    swarm *s = f->swarm;
    const int n = s->config.agents;
    int end = METRICS_FLIES, estimated = 0;
    for (; slots > 0 && !end && !(f->log && sim_log_is_full(f->log, n)); slots--) {
        const int64_t slot = f->slot++;
        if (f->course) swarm_advance(s, f->course, slot);
        const int frames = swarm_begin(s, slot);
        const int outcome = frames > 1 ? SIM_COLLISION : frames;
        const uint8_t *received = NULL;
        if (f->log) sim_log_open(f->log, s);
        if (!s->shared) metrics_compare(f->metrics, slot, n, s->digest, s->chosen);
        advance_chains(&f->losses, n, slot);
        if (frames == 1 && !f->losses.none) {
            lose(&f->losses, n, slot, s->senders[0], f->received);
            received = f->received;
        }
        swarm_complete(s, slot, estimated, outcome == SIM_SUCCESS, received);
        estimated = slot + 1 >= f->metrics->news_from; /* by the metrics */
        f->metrics->frames += frames;
        end = metrics_update(f->metrics, slot, outcome);
        if (f->log) sim_log_close(f->log, s, slot, outcome, received);
    }
    return end;
}
