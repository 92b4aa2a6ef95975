/* Policy lease: an agent's decisions. Who may send in a slot, and what silence means.
 *
 * Only the owner of a turn gives it away, in a frame of its own, for good, and at most up to its
 * next main anchor; an agent that was given it may hand it on in the same way. So the sender in a
 * turn is its owner or the last one that was named for it. docs/reference/protocol.md has states
 * and events, docs/explanation/policies.md the proof.
 */
#include <string.h>

#include "lease.h"

static const int64_t GONE = INT64_MIN / 4; /* heard: said that it leaves */

static int main_every(const dtsa_config *c)
{
    return c->lease.main_every ? c->lease.main_every : c->lease.anchor_every;
}

static int ring_length(const dtsa_config *c) { return (main_every(c) + 2) * c->agents; }

static size_t state_bytes(const dtsa_config *c)
{
    const size_t n = (size_t)c->agents;
    return (sizeof(lease_agent) + 8 * n + 2 * (size_t)ring_length(c) + 4 * n + 7) / 8 * 8;
}

static int64_t patience(const dtsa_config *c, int rounds)
{
    const int64_t silence = 6 * (int64_t)rounds * c->agents;
    if (c->lease.patience) return c->lease.patience;
    return silence > 1000 ? silence : 1000;
}

lease_scope lease_of(const dtsa_agent *agent)
{
    const dtsa_config *c = agent->table->config;
    lease_scope v;
    v.n = c->agents;
    v.self = agent->self;
    v.every = c->lease.anchor_every;
    v.main = main_every(c);
    v.window = ring_length(c);
    v.patience = patience(c, v.every);
    v.long_patience = patience(c, v.main);
    v.a = agent->state;
    v.heard = (int64_t *)(v.a + 1);
    v.lessee = (uint8_t *)(v.heard + v.n);
    v.issuer = v.lessee + v.window;
    v.miss = v.issuer + v.window;
    v.quiet = v.miss + v.n;
    v.settled = v.quiet + v.n;
    v.resting = v.settled + v.n;
    return v;
}

int lease_is_anchor(const lease_scope *v, int64_t slot)
{
    return (slot / v->n + slot % v->n) % v->every == 0;
}

int lease_is_main(const lease_scope *v, int64_t slot)
{
    return (slot / v->n + slot % v->n) % v->main == 0;
}

/* Who rests may speak in its main anchors only, and so may who was never heard. */
static int64_t patience_with(const lease_scope *v, int k)
{
    return v->resting[k] || v->heard[k] == -1 ? v->long_patience : v->patience;
}

int lease_alive(const lease_scope *v, int k, int64_t slot)
{
    return v->heard[k] >= 0 && slot - v->heard[k] <= patience_with(v, k);
}

int lease_absent(const lease_scope *v, int k, int64_t slot)
{
    const int64_t sign = v->heard[k] == -1 ? v->a->born : v->heard[k];
    return slot - sign > patience_with(v, k);
}

int lease_scheduled(const lease_scope *v, int64_t slot)
{
    const int given = v->lessee[slot % v->window], owner = (int)(slot % v->n);
    if (given == LEASE_OPEN) return -1;
    if (given != LEASE_NONE) return given - 1;
    if (lease_absent(v, owner, slot) || (v->quiet[owner] && !lease_is_anchor(v, slot))) return -1;
    return owner;
}

void lease_note(lease_scope *v, int64_t slot, int sender, int64_t turn, int lessee, int issuer)
{
    if (lessee == LEASE_NONE || turn <= v->a->now || turn >= v->a->now + v->window ||
        lease_is_main(v, turn))
        return;
    uint8_t *known = &v->lessee[turn % v->window], *by = &v->issuer[turn % v->window];
    const int mine = lessee == v->self + 1, from_me = *by == v->self + 1 || *by == LEASE_HANDED;
    if (*known == LEASE_NONE) {
        *known = (uint8_t)lessee;
        *by = (uint8_t)issuer;
    } else if (lessee == *known) {
        if (!*by) *by = (uint8_t)issuer;
    } else if (sender == *known) {
        /* Its lessee hands it on. An older frame than my own last one may not know what that said
         * of the turn. */
        if (mine && slot <= v->a->spoke) return;
        *known = (uint8_t)lessee;
        if (mine) *by = 0;
    } else if (!from_me && issuer && *by && issuer != *by && lessee < *known) {
        /* Two have given it away: only adoption can do that. The smaller id, so that all who know
         * both agree. */
        *known = (uint8_t)lessee;
        *by = (uint8_t)issuer;
    }
}

int lease_turns(const lease_scope *v, int64_t slot, int c_s, int64_t *turns, int room)
{
    int count = 0, own = 1;
    for (int j = 1; j <= v->main; j++)
        for (int i = c_s; i >= 0; i--) {
            const int64_t turn = slot + (int64_t)j * v->n - i;
            /* Its own turns up to its next main anchor; those of the dead as far as it goes, but
             * for anchors. */
            if (!i && lease_is_main(v, turn)) own = 0;
            if (i ? lease_is_anchor(v, turn) : !own) continue;
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
    a->now = v->heard[v->self] = slot;
    a->wakers -= a->wakers / v->n;
}

static void lease_begin(dtsa_agent *agent)
{
    memset(agent->state, 0, state_bytes(agent->table->config));
}

/* Whoever begins with slot 0 begins with everybody else. Whoever comes later may have lived before,
 * and may have given turns away that it knows nothing of. */
static void start(lease_scope *v, int64_t slot)
{
    lease_agent *a = v->a;
    a->started = 1;
    a->born = a->now = a->claimed = slot;
    a->idle_since = a->woke = a->spoke = -1;
    for (int k = 0; k < v->n; k++) v->heard[k] = -1;
    if (slot == 0) return;
    a->probation = 1;
    a->woke = slot;
}

static void watch_goal(const dtsa_agent *agent, lease_scope *v, int64_t slot)
{
    lease_agent *a = v->a;
    const int moving = agent_far_from_goal(agent);
    if (!moving) {
        if (a->idle_since < 0) a->idle_since = slot;
    } else if (a->idle_since >= 0) {
        a->idle_since = -1;
        a->woke = slot;
        a->attempts = 0;
    }
    a->moving = (uint8_t)moving;
}

static int has_own_turn_soon(const lease_scope *v, int self, int64_t slot)
{
    for (int64_t t = slot + 1; t <= slot + v->n / 2; t++) {
        const int given = v->lessee[t % v->window];
        if (given == self + 1) return 1;
        if (t % v->n == self && given == LEASE_NONE && (lease_is_anchor(v, t) || !v->a->probation))
            return 1;
    }
    return 0;
}

/* An OPEN turn is for those whom nobody expects. The first one is taken at once, or with a chance
 * that falls with the number of agents that wake in these days; without an answer (a gossip entry
 * of mine in the frames that follow) the chance halves each time, so that many who woke together
 * get out of each other's way. */
static int uses_open_turn(const dtsa_agent *agent, const lease_scope *v, int64_t slot)
{
    const int self = agent->self;
    if (v->a->woke < 0 || has_own_turn_soon(v, self, slot)) return 0;
    const int halvings = v->a->attempts < 5 ? v->a->attempts : 5;
    const double chance = 1.0 / ((1.0 + 3.0 * v->a->wakers) * (double)(1 << halvings));
    const uint64_t what = ((uint64_t)slot << 16) + (uint64_t)self + 0x4f50454eULL;
    return draw_uniform(agent->table->config->key, what) < chance;
}

static choice expect(int index, int reason) { return (choice){index, reason, 0.0}; }

/* Nobody has been given this turn: it is its owner's. */
static choice decide_unleased(int self, lease_scope *v, int64_t slot)
{
    lease_agent *a = v->a;
    const int owner = (int)(slot % v->n), anchor = lease_is_anchor(v, slot);
    const int reason = anchor ? DTSA_REASON_LEASE_ANCHOR : DTSA_REASON_LEASE_OWN;
    if (owner == self) {
        if (anchor || !a->probation) return expect(self, reason);
        return expect(-1, DTSA_REASON_LEASE_PROBATION);
    }
    a->expected = lease_scheduled(v, slot);
    if (a->expected >= 0) return expect(a->expected, reason);
    return expect(-1, v->quiet[owner] ? DTSA_REASON_LEASE_PROBATION : DTSA_REASON_LEASE_ABSENT);
}

static choice lease_decide(dtsa_agent *agent, int64_t slot)
{
    const int self = agent->self;
    lease_scope v = lease_of(agent);
    lease_agent *a = v.a;
    if (!agent->present) {
        if (a->started) agent_forget(agent); /* whatever it knew is gone when it comes back */
        return choose_nobody();
    }
    if (!a->started) start(&v, slot);
    roll(&v, slot);
    watch_goal(agent, &v, slot);
    a->heard_now = 0;
    a->expected = -1;
    const int given = v.lessee[slot % v.window], issuer = v.issuer[slot % v.window];
    if (given == LEASE_NONE) return decide_unleased(self, &v, slot);
    if (given == LEASE_OPEN)
        return expect(uses_open_turn(agent, &v, slot) ? self : -1, DTSA_REASON_LEASE_OPEN);
    a->expected = given - 1;
    const int adopted = issuer && issuer != LEASE_HANDED && issuer != (int)(slot % v.n) + 1;
    const int reason = adopted ? DTSA_REASON_LEASE_ADOPTED : DTSA_REASON_LEASE_LEASED;
    /* A lease that I hear of while others may think me dead, or I them, may be one of two. */
    return expect(a->expected == self && a->probation ? -1 : a->expected, reason);
}

/* ---- what was heard ---- */

static void check_claim(const dtsa_agent *agent, lease_scope *v, int64_t slot,
                        const extended_frame *e, int was_absent)
{
    lease_agent *a = v->a;
    const int sender = e->own.sender - 1, distance = (sender - agent->self + v->n) % v->n;
    if (!agent->table->config->lease.adoption || e->leaving) return;
    if (distance <= e->c_s || (was_absent && !e->probation)) {
        /* It thinks me dead and gives my turns away; or it lived all the time elsewhere, so others
         * there may. */
        a->probation = 1;
        a->anchored = 0;
        a->claimed = slot;
    } else if (a->probation && a->anchored && !e->probation && e->c_s == distance - 1) {
        a->probation = 0; /* the one that would give my turns away knows that I live */
    }
}

/* Signs of life of others; one of mine says that I have been heard. */
static void hear_gossip(const dtsa_agent *agent, lease_scope *v, int64_t slot,
                        const extended_frame *e)
{
    for (int i = 0; i < e->gossip_count; i++) {
        const gossip_entry *g = &e->gossip[i];
        const int64_t alive = slot - g->age;
        int64_t *heard = &v->heard[g->id - 1];
        if (g->id - 1 == agent->self) {
            if (v->a->woke < 0 || alive < v->a->woke) continue;
            v->a->woke = -1;
            gossip_confirm(agent->table, alive, g);
        } else if (*heard < alive && *heard != GONE) {
            *heard = alive;
        }
    }
}

static void lease_listen(dtsa_agent *agent, int64_t slot, const extended_frame *e, int wakes)
{
    lease_scope v = lease_of(agent);
    lease_agent *a = v.a;
    const int sender = e->own.sender - 1;
    if (!a->started) return;
    const int was_absent = lease_absent(&v, sender, slot);
    a->wakers += wakes;
    a->heard_now = 1;
    a->deaf = 0;
    v.miss[sender] = 0;
    v.quiet[sender] = (uint8_t)e->probation;
    v.heard[sender] = e->leaving ? GONE : slot;
    check_claim(agent, &v, slot, e, was_absent);
    v.resting[sender] = !e->own.c_r;
    hear_gossip(agent, &v, slot, e);
    if (slot % v.n == sender) v.settled[sender] = 0;
    if (e->lease_count) {
        int64_t turns[SECTIONS * SECTION_BYTES];
        const int count = lease_turns(&v, slot, e->c_s, turns, e->lease_count);
        for (int i = 0; i < count; i++) {
            lease_note(&v, slot, e->own.sender, turns[i], e->leases[i], e->own.sender);
            if (e->leases[i] && turns[i] % v.n == sender && lease_is_anchor(&v, turns[i]))
                v.settled[sender] = 1;
        }
    }
    for (int d = 0, i = 0; d < RELAY_REACH && e->relay_mask >> d; d++)
        if (e->relay_mask >> d & 1)
            lease_note(&v, slot, e->own.sender, slot + 1 + d, e->relay_ids[i++], 0);
    for (int b = 0; b < 8 * FAR_BYTES && e->far_id; b++)
        if (e->far_mask[b >> 3] >> (b & 7) & 1)
            lease_note(&v, slot, e->own.sender, slot + RELAY_REACH + 1 + b, e->far_id, 0);
}

/* ---- the slot is over ---- */

static void end_probation(const dtsa_agent *agent, lease_scope *v, int64_t slot)
{
    lease_agent *a = v->a;
    if (slot % v->n == agent->self && lease_is_main(v, slot)) a->anchored = 1;
    if (!a->probation || !a->anchored) return;
    /* Leases of an earlier life reach up to my first main anchor at most. Without adoption nobody
     * else gives my turns away; with it, everybody who might has spoken twice by then. */
    const int64_t quiet = slot - a->claimed;
    if (!agent->table->config->lease.adoption ||
        (quiet >= 2 * (int64_t)v->main * v->n && a->deaf <= LEASE_DEAF))
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

static void lease_end(dtsa_agent *agent, int64_t slot)
{
    lease_scope v = lease_of(agent);
    lease_agent *a = v.a;
    if (!agent->present || !a->started) return;
    if (agent->decision.sends) {
        if (agent->decision.reason == DTSA_REASON_LEASE_OPEN)
            a->attempts += a->attempts < 255;
        else
            a->woke = -1;
    } else if (!a->heard_now) {
        note_silence(&v, slot);
    }
    end_probation(agent, &v, slot);
    if (a->leaving) agent->present = 0;
}

static void lease_status(const dtsa_agent *agent, dtsa_status *out)
{
    const lease_scope v = lease_of(agent);
    out->probation = v.a->probation;
    out->deaf = v.a->deaf > LEASE_DEAF;
    out->silent_slots = v.a->deaf;
    out->woke = v.a->woke;
    out->alive = 1;
    for (int k = 0; k < v.n; k++) {
        if (k == agent->self) continue;
        out->alive += lease_alive(&v, k, v.a->now);
        out->absent += lease_absent(&v, k, v.a->now);
    }
}

const policy_row policy_lease = {
    .name = "lease",
    .bytes = state_bytes,
    .begin = lease_begin,
    .decide = lease_decide,
    .speak = lease_fill,
    .heard = lease_listen,
    .end = lease_end,
    .status = lease_status,
    .needs_extended = 1,
    .says_leaving = 1,
};
