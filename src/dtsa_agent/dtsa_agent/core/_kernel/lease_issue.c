/* Policy lease: what an agent says about turns: those it gives away, and those it knows to be given away. */
#include <string.h>

#include "lease.h"

static const double BUSY = 0.5;

typedef struct {
    int alive;                /* N_alive: me and those heard of lately */
    int members;              /* N_p: those in A_p that do not miss their turns */
    uint8_t able[LEASE_OPEN]; /* may be given a turn */
} electorate;

static void count_electorate(const swarm *s, int l, const lease_scope *v, int64_t slot,
                             electorate *who)
{
    const uint8_t *in_ap = s->in_ap + (long)l * s->n;
    const int self = s->local[l];
    who->alive = 1;
    who->members = who->able[self] = v->a->moving;
    for (int k = 0; k < v->n; k++) {
        if (k == self) continue;
        const int alive = lease_alive(v, k, slot);
        who->able[k] = alive && in_ap[k] && !v->quiet[k] && v->miss[k] < LEASE_MISSED;
        who->alive += alive;
        who->members += who->able[k];
    }
}

/* Number of consecutive ids before me that nobody has heard of for long. */
static int count_absent_before(const lease_scope *v, int self, int64_t slot)
{
    int count = 0;
    while (count < v->n - 1 && lease_absent(v, (self - 1 - count + v->n) % v->n, slot)) count++;
    return count;
}

/* To whom a turn is worth most: the longest wait before it, times the wait that follows. */
static int choose_lessee(const swarm *s, int l, const lease_scope *v, const electorate *who,
                         int64_t slot, int64_t turn)
{
    const int n = v->n;
    const int64_t *sent = s->sent_slot + (long)l * n;
    int before[LEASE_OPEN], after[LEASE_OPEN];
    for (int k = 0; k < n; k++) {
        before[k] = turn - sent[k] <= n && sent[k] >= 0 ? (int)(turn - sent[k]) : n + 1;
        after[k] = n + 1;
    }
    for (int d = n; d >= 1; d--) {
        const int k = turn - d > slot ? lease_scheduled(v, turn - d) : -1,
                  m = lease_scheduled(v, turn + d);
        if (k >= 0 && d < before[k]) before[k] = d;
        if (m >= 0) after[m] = d;
    }
    int best = -1;
    long worth = 0;
    for (int k = 0; k < n; k++) {
        if (!who->able[k]) continue;
        const long w =
            (long)before[k] * (after[k] < who->members + 1 ? after[k] : who->members + 1);
        if (best < 0 || w > worth) {
            best = k;
            worth = w;
        }
    }
    return best;
}

/* How many of its next turns an idle agent gives away. */
static int depth(const swarm *s, int l, const lease_scope *v, const electorate *who, int64_t slot)
{
    const lease_agent *a = v->a;
    if (a->idle_since < 0 || !who->members || a->deaf > LEASE_DEAF || slot < v->n) return 0;
    if (who->members > s->lease.share * who->alive) return 0;
    if (s->final[l]) return v->every;
    const double turns = s->lease.depth_rate * (double)(slot - a->idle_since) / v->n;
    return turns < v->every ? (int)turns : v->every;
}

/* One of S turns is for those who wake; two, while many do. */
static int is_open(const swarm *s, const lease_scope *v, int64_t turn)
{
    const int every = s->lease.open_every;
    if (!every) return 0;
    return turn % every == 0 || (v->a->wakers > BUSY && turn % every == every / 2);
}

static void issue(swarm *s, int l, lease_scope *v, int64_t slot, extended_frame *e)
{
    int64_t turns[LEASE_ROOM];
    electorate who;
    const int self = s->local[l], count = lease_turns(v, slot, e->c_s, turns, LEASE_ROOM);
    count_electorate(s, l, v, slot, &who);
    const int own = e->leaving ? 0 : depth(s, l, v, &who, slot),
              adopted = v->a->idle_since >= 0 ? v->every : 1;
    for (int i = 0; i < count; i++) {
        const int64_t turn = turns[i];
        const int mine = turn % v->n == self;
        uint8_t *given = &v->lessee[turn % v->window];
        if (*given == LEASE_NONE && (turn - slot + v->n - 1) / v->n <= (mine ? own : adopted) &&
            !v->a->probation) {
            if (mine && is_open(s, v, turn))
                *given = LEASE_OPEN;
            else if (who.members && (mine || v->a->deaf <= LEASE_DEAF))
                *given = (uint8_t)(choose_lessee(s, l, v, &who, slot, turn) + 1);
            if (*given != LEASE_NONE) v->issuer[turn % v->window] = (uint8_t)(self + 1);
        }
        e->leases[i] = *given;
        if (*given != LEASE_NONE) e->lease_count = i + 1;
    }
}

static void relay(const lease_scope *v, int self, int64_t slot, extended_frame *e)
{
    int count = 0;
    for (int d = 1; d <= RELAY_REACH && count < RELAY_IDS; d++) {
        const int64_t turn = slot + d;
        const int given = v->lessee[turn % v->window];
        if (given == LEASE_NONE || (e->lease_count && turn % v->n == self)) continue;
        e->relay_mask |= 1u << (d - 1);
        e->relay_ids[count++] = (uint8_t)given;
    }
}

void lease_fill(swarm *s, int l, int64_t slot, extended_frame *e)
{
    const int self = s->local[l];
    lease_scope v = lease_of(s, l);
    const int own_turn = slot % v.n == self;
    e->probation = v.a->probation;
    e->leaving = own_turn && s->present[l] == PRESENT_LEAVING;
    v.a->leaving = (uint8_t)e->leaving;
    e->c_s = s->lease.adoption && !v.a->probation && !e->leaving
                 ? count_absent_before(&v, self, slot)
                 : 0;
    if (own_turn) issue(s, l, &v, slot, e);
    relay(&v, self, slot, e);
}
