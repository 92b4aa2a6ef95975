/* Policy lease: what an agent says about turns: those it gives away, and those it knows to be given away. */
#include <string.h>

#include "lease.h"

static const double BUSY = 0.5;

typedef struct {
    int alive;               /* N_alive: me and those heard of lately */
    int members;             /* N_p: those in A_p that do not miss their turns */
    uint8_t *able;           /* (n) may be given a turn */
    uint8_t *before, *after; /* (n) for choose_lessee */
} electorate;

static void count_electorate(const dtsa_agent *agent, const lease_scope *v, int64_t slot,
                             electorate *who)
{
    const uint8_t *in_ap = agent->table->in_ap;
    const int self = agent->self;
    who->able = (uint8_t *)agent->table->scratch;
    who->before = who->able + v->n;
    who->after = who->before + v->n;
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
static int choose_lessee(const int64_t *sent, const lease_scope *v, const electorate *who,
                         int64_t slot, int64_t turn)
{
    const int n = v->n;
    uint8_t *before = who->before, *after = who->after; /* n + 1 fits: n is 254 at most */
    for (int k = 0; k < n; k++) {
        before[k] = (uint8_t)(turn - sent[k] <= n && sent[k] >= 0 ? turn - sent[k] : n + 1);
        after[k] = (uint8_t)(n + 1);
    }
    for (int d = n; d >= 1; d--) {
        const int k = turn - d > slot ? lease_scheduled(v, turn - d) : -1,
                  m = lease_scheduled(v, turn + d);
        if (k >= 0 && d < before[k]) before[k] = (uint8_t)d;
        if (m >= 0) after[m] = (uint8_t)d;
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
static int depth(const dtsa_agent *agent, const lease_scope *v, const electorate *who, int64_t slot)
{
    const dtsa_lease_config *c = &agent->table->config->lease;
    const lease_agent *a = v->a;
    if (a->idle_since < 0 || !who->members || a->deaf > LEASE_DEAF || slot < v->n) return 0;
    if (who->members > c->share * who->alive) return 0;
    if (agent->final) return v->every;
    const double turns = c->depth_rate * (double)(slot - a->idle_since) / v->n;
    return turns < v->every ? (int)turns : v->every;
}

/* One of S turns is for those who wake; two, while many do. */
static int is_open(int every, const lease_scope *v, int64_t turn)
{
    if (!every) return 0;
    return turn % every == 0 || (v->a->wakers > BUSY && turn % every == every / 2);
}

static void issue(const dtsa_agent *agent, lease_scope *v, int64_t slot, extended_frame *e)
{
    int64_t turns[LEASE_ROOM];
    electorate who;
    const int self = agent->self, count = lease_turns(v, slot, e->c_s, turns, LEASE_ROOM);
    count_electorate(agent, v, slot, &who);
    const int own = e->leaving ? 0 : depth(agent, v, &who, slot),
              adopted = v->a->idle_since >= 0 ? v->every : 1;
    for (int i = 0; i < count; i++) {
        const int64_t turn = turns[i];
        const int mine = turn % v->n == self;
        uint8_t *given = &v->lessee[turn % v->window];
        if (*given == LEASE_NONE && (turn - slot + v->n - 1) / v->n <= (mine ? own : adopted) &&
            !v->a->probation) {
            if (mine && is_open(agent->table->config->lease.open_every, v, turn))
                *given = LEASE_OPEN;
            else if (who.members && (mine || v->a->deaf <= LEASE_DEAF))
                *given = (uint8_t)(choose_lessee(agent->table->sent_slot, v, &who, slot, turn) + 1);
            if (*given != LEASE_NONE) v->issuer[turn % v->window] = (uint8_t)(self + 1);
        }
        e->leases[i] = *given;
        if (*given != LEASE_NONE) e->lease_count = i + 1;
    }
}

static void relay(const lease_scope *v, int self, int64_t slot, extended_frame *e)
{
    int count = 0;
    for (int d = 1; d <= RELAY_REACH && d < v->window && count < RELAY_IDS; d++) {
        const int64_t turn = slot + d;
        const int given = v->lessee[turn % v->window];
        if (given == LEASE_NONE || (e->lease_count && turn % v->n == self)) continue;
        e->relay_mask |= 1u << (d - 1);
        e->relay_ids[count++] = (uint8_t)given;
    }
}

void lease_fill(dtsa_agent *agent, int64_t slot, extended_frame *e)
{
    const int self = agent->self;
    lease_scope v = lease_of(agent);
    const int own_turn = slot % v.n == self;
    e->probation = v.a->probation;
    e->leaving = own_turn && agent->present == PRESENT_LEAVING;
    v.a->leaving = (uint8_t)e->leaving;
    if (agent->table->config->lease.adoption && !v.a->probation && !e->leaving)
        e->c_s = count_absent_before(&v, self, slot);
    if (own_turn) issue(agent, &v, slot, e);
    relay(&v, self, slot, e);
}
