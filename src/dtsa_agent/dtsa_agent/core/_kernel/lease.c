/* Policy lease: an agent's decisions. Who may send in a slot, and what silence means.
 *
 * Only the owner of a turn gives it away, in a frame of its own, for good, and at most up to its next anchor: so whoever
 * sends in a turn is its owner or the one agent that its owner named. docs/protocol.md has states, events and proof.
 */
#include <string.h>

#include "lease.h"

static const double CROWD = 8.0;
static const int64_t GONE = INT64_MIN / 4; /* heard: said goodbye */

static long ring_length(int n, int every) { return (long)(every + 2) * n; }

long lease_state_bytes(int n, int every)
{
    const long bytes = (long)sizeof(lease_agent) + 8L * n + 2 * ring_length(n, every) + 2L * n;
    return (bytes + 7) / 8 * 8;
}

lease_scope lease_of(const swarm *s, int l)
{
    lease_scope v;
    uint8_t *block = s->lease_state + (long)l * lease_state_bytes(s->n, s->lease.anchor_every);
    v.n = s->n;
    v.every = s->lease.anchor_every;
    v.window = (int)ring_length(v.n, v.every);
    v.patience = 6 * (int64_t)v.every * v.n > 1000 ? 6 * (int64_t)v.every * v.n : 1000;
    v.a = (lease_agent *)block;
    v.heard = (int64_t *)(block + sizeof(lease_agent));
    v.lessee = (uint8_t *)(v.heard + v.n);
    v.issuer = v.lessee + v.window;
    v.miss = v.issuer + v.window;
    v.quiet = v.miss + v.n;
    return v;
}

int lease_is_anchor(const lease_scope *v, int64_t slot)
{
    return (slot / v->n + slot % v->n) % v->every == 0;
}

int lease_alive(const lease_scope *v, int k, int64_t slot)
{
    return v->heard[k] >= 0 && slot - v->heard[k] <= v->patience;
}

int lease_absent(const lease_scope *v, int k, int64_t slot)
{
    const int64_t sign = v->heard[k] == -1 ? v->a->born : v->heard[k];
    return slot - sign > v->patience;
}

int lease_scheduled(const lease_scope *v, int64_t slot)
{
    const int given = v->lessee[slot % v->window], owner = (int)(slot % v->n);
    if (given == LEASE_OPEN) return -1;
    if (given != LEASE_NONE) return given - 1;
    if (lease_absent(v, owner, slot) || (v->quiet[owner] && !lease_is_anchor(v, slot))) return -1;
    return owner;
}

void lease_note(lease_scope *v, int64_t turn, int lessee, int issuer)
{
    if (lessee == LEASE_NONE || turn <= v->a->now || turn >= v->a->now + v->window ||
        lease_is_anchor(v, turn))
        return;
    uint8_t *there = &v->lessee[turn % v->window], *by = &v->issuer[turn % v->window];
    /* Two leases of one turn: only adoption can do that. The smaller id, so that all who know both agree. */
    if (*there == LEASE_NONE || lessee < *there) {
        *there = (uint8_t)lessee;
        *by = (uint8_t)issuer;
    } else if (lessee == *there && !*by) {
        *by = (uint8_t)issuer;
    }
}

int lease_turns(const lease_scope *v, int64_t slot, int c_s, int64_t *turns, int room)
{
    int count = 0, own = 1;
    for (int j = 1; j <= v->every; j++)
        for (int i = c_s; i >= 0; i--) {
            const int64_t turn = slot + (int64_t)j * v->n - i;
            const int anchor = lease_is_anchor(v, turn);
            if (!i && anchor)
                own =
                    0; /* its own turns up to its next anchor, those of the dead as far as it goes */
            if (anchor || (!i && !own)) continue;
            if (count == room) return count;
            turns[count++] = turn;
        }
    return count;
}

static void roll(lease_scope *v, int64_t slot)
{
    lease_agent *a = v->a;
    if (slot - a->now >= v->window) {
        memset(v->lessee, 0, 2 * (size_t)v->window);
    } else {
        for (int64_t t = a->now; t < slot; t++)
            v->lessee[t % v->window] = v->issuer[t % v->window] = 0;
    }
    a->now = slot;
    a->wakers -= a->wakers / v->n;
}

void lease_restart(swarm *s, int l)
{
    memset(s->lease_state + (long)l * lease_state_bytes(s->n, s->lease.anchor_every), 0,
           (size_t)lease_state_bytes(s->n, s->lease.anchor_every));
}

/* Whoever begins with slot 0 begins with everybody else. Whoever comes later may have lived before, and may have given
 * turns away that it knows nothing of. */
static void start(lease_scope *v, int64_t slot)
{
    lease_agent *a = v->a;
    a->started = 1;
    a->born = a->now = a->claimed = slot;
    a->idle_since = a->woke = -1;
    for (int k = 0; k < v->n; k++) v->heard[k] = -1;
    if (slot == 0) return;
    a->probation = 1;
    a->woke = slot;
}

static void watch_goal(swarm *s, int l, lease_scope *v, int64_t slot)
{
    lease_agent *a = v->a;
    const int moving = swarm_far_from_goal(s, l);
    if (!moving) {
        if (a->idle_since < 0) a->idle_since = slot;
    } else if (a->idle_since >= 0) {
        a->idle_since = -1;
        a->woke = slot;
        a->attempts = 0;
    }
    a->moving = (uint8_t)moving;
}

static int own_right_is_near(const lease_scope *v, int self, int64_t slot)
{
    for (int64_t t = slot + 1; t <= slot + v->n / 2; t++) {
        const int given = v->lessee[t % v->window];
        if (given == self + 1) return 1;
        if (t % v->n == self &&
            (lease_is_anchor(v, t) || (given == LEASE_NONE && !v->a->probation)))
            return 1;
    }
    return 0;
}

/* An OPEN turn is for those whom nobody expects. The first one is taken at once, or with a chance that falls with the number
 * of agents that wake in these days; without an answer (a gossip entry of mine in the frames that follow) the chance halves
 * each time, so that many who woke together get out of each other's way. */
static int takes_open(const swarm *s, const lease_scope *v, int self, int64_t slot)
{
    if (v->a->woke < 0 || own_right_is_near(v, self, slot)) return 0;
    const int halvings = v->a->attempts < 5 ? v->a->attempts : 5;
    const double chance = 1.0 / ((1.0 + CROWD * v->a->wakers) * (double)(1 << halvings));
    const uint64_t draw =
        mix64(s->key ^ mix64(((uint64_t)slot << 16) + (uint64_t)self + 0x4f50454eULL));
    return (double)(draw >> 11) * 0x1p-53 < chance;
}

int lease_decide(swarm *s, int l, int64_t slot, int *reason)
{
    const int self = s->local[l];
    lease_scope v = lease_of(s, l);
    lease_agent *a = v.a;
    *reason = REASON_NOBODY;
    if (!s->present[l]) {
        if (a->started) { /* whatever it knew is gone when it comes back */
            lease_restart(s, l);
            swarm_reset_table(s, l);
        }
        return -1;
    }
    if (!a->started) start(&v, slot);
    roll(&v, slot);
    watch_goal(s, l, &v, slot);
    a->heard_now = 0;
    a->expected = -1;
    const int owner = (int)(slot % v.n), given = v.lessee[slot % v.window],
              anchor = lease_is_anchor(&v, slot);
    if (given == LEASE_OPEN) {
        *reason = REASON_LEASE_OPEN;
        return takes_open(s, &v, self, slot) ? self : -1;
    }
    if (given != LEASE_NONE) {
        const int issuer = v.issuer[slot % v.window];
        *reason = issuer && issuer != owner + 1 ? REASON_LEASE_ADOPTED : REASON_LEASE_LEASED;
        a->expected = given - 1;
        /* A lease that I hear of while others may think me dead, or I them, may be one of two. */
        return a->expected == self && a->probation ? -1 : a->expected;
    }
    *reason = anchor ? REASON_LEASE_ANCHOR : REASON_LEASE_OWN;
    if (owner == self) {
        if (anchor || !a->probation) return self;
        *reason = REASON_LEASE_PROBATION;
        return -1;
    }
    a->expected = lease_scheduled(&v, slot);
    if (a->expected < 0) *reason = v.quiet[owner] ? REASON_LEASE_PROBATION : REASON_LEASE_ABSENT;
    return a->expected;
}

/* ---- what was heard ---- */

static void judge_claim(const swarm *s, lease_scope *v, int self, int64_t slot,
                        const extended_frame *e, int was_absent)
{
    lease_agent *a = v->a;
    const int sender = e->own.sender - 1, distance = (sender - self + v->n) % v->n;
    if (!s->lease.adoption || e->leaving) return;
    if (distance <= e->c_s || (was_absent && !e->probation)) {
        /* It thinks me dead and gives my turns away; or it lived all the time elsewhere, so others there may. */
        a->probation = 1;
        a->anchored = 0;
        a->claimed = slot;
    } else if (a->probation && a->anchored && !e->probation && e->c_s == distance - 1) {
        a->probation = 0; /* the one that would give my turns away knows that I live */
    }
}

void lease_listen(swarm *s, int l, int64_t slot, const extended_frame *e, int wakes)
{
    lease_scope v = lease_of(s, l);
    lease_agent *a = v.a;
    const int self = s->local[l], sender = e->own.sender - 1;
    if (!a->started) return;
    const int was_absent = lease_absent(&v, sender, slot);
    a->wakers += wakes;
    a->heard_now = 1;
    a->deaf = 0;
    v.miss[sender] = 0;
    v.quiet[sender] = (uint8_t)e->probation;
    v.heard[sender] = e->leaving ? GONE : slot;
    judge_claim(s, &v, self, slot, e, was_absent);
    for (int i = 0; i < e->gossip_count; i++) {
        const gossip_entry *g = &e->gossip[i];
        const int64_t alive = slot - g->age;
        if (g->id - 1 == self) {
            if (a->woke >= 0 && alive >= a->woke) a->woke = -1; /* I have been heard */
        } else if (v.heard[g->id - 1] < alive && v.heard[g->id - 1] != GONE) {
            v.heard[g->id - 1] = alive;
        }
    }
    if (e->lease_count) {
        int64_t turns[SECTIONS * SECTION_BYTES];
        const int count = lease_turns(&v, slot, e->c_s, turns, e->lease_count);
        for (int i = 0; i < count; i++) lease_note(&v, turns[i], e->leases[i], e->own.sender);
    }
    for (int d = 0, i = 0; d < RELAY_REACH && e->relay_mask >> d; d++)
        if (e->relay_mask >> d & 1) lease_note(&v, slot + 1 + d, e->relay_ids[i++], 0);
}

/* ---- the slot is over ---- */

static void end_probation(const swarm *s, lease_scope *v, int self, int64_t slot)
{
    lease_agent *a = v->a;
    if (slot % v->n == self && lease_is_anchor(v, slot)) a->anchored = 1;
    if (!a->probation || !a->anchored) return;
    /* Leases of an earlier life reach up to my first anchor at most. Without adoption nobody else gives my turns away;
     * with it, everybody who might has spoken twice by then. */
    const int64_t quiet = slot - a->claimed;
    if (!s->lease.adoption || (quiet >= 2 * (int64_t)v->every * v->n && a->deaf <= LEASE_DEAF))
        a->probation = 0;
}

static void note_silence(const lease_scope *v, int64_t slot)
{
    lease_agent *a = v->a;
    if (a->expected < 0 || v->miss[a->expected] >= LEASE_MISSED ||
        lease_absent(v, a->expected, slot))
        return;
    if (a->deaf <= LEASE_DEAF) a->deaf++;
    if (a->deaf <= LEASE_DEAF) v->miss[a->expected]++;
}

void lease_end(swarm *s, int64_t slot)
{
    for (int l = 0; l < s->local_count; l++) {
        lease_scope v = lease_of(s, l);
        lease_agent *a = v.a;
        if (!s->present[l] || !a->started) continue;
        if (s->sends[l]) {
            if (s->reason[l] == REASON_LEASE_OPEN)
                a->attempts += a->attempts < 255;
            else
                a->woke = -1;
        } else if (!a->heard_now) {
            note_silence(&v, slot);
        }
        end_probation(s, &v, s->local[l], slot);
        if (a->leaving) s->present[l] = 0;
    }
}
