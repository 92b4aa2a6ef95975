/* What the air carried: checked once, then taken in by each table that hears it. */
#include "policy/policy.h"

static int known(int id, int n) { return id <= n; }

/* Ids that exist, and leases said by the owner of the slot only. */
static int known_ids(int n, const extended_frame *e, int64_t slot)
{
    const int own_turn = slot % n == e->own.sender - 1;
    if (e->c_s >= n || !known(e->far_id, n) || (e->lease_count && !own_turn)) return 0;
    for (int i = 0; i < e->gossip_count; i++)
        if (!known(e->gossip[i].id, n)) return 0;
    for (int i = 0; i < e->lease_count; i++)
        if (!known(e->leases[i], n) && e->leases[i] != LEASE_OPEN) return 0;
    for (int i = 0; i < RELAY_IDS && e->relay_mask; i++)
        if (!known(e->relay_ids[i], n) && e->relay_ids[i] != LEASE_OPEN) return 0;
    return 1;
}

int frame_admit(const dtsa_config *c, int64_t slot, const uint8_t *data, long length,
                heard_frame *heard)
{
    extended_frame *e = &heard->e;
    const int extended = c->profile == DTSA_PROFILE_EXTENDED;
    if (extended) {
        if (extended_decode(data, length, c->position_step, e) != FRAME_OK) return HEARD_MALFORMED;
    } else if (frame_decode(data, length, c->position_step, &e->own) != FRAME_OK ||
               e->own.profile == DTSA_PROFILE_EXTENDED) {
        return HEARD_MALFORMED;
    }
    const int late = e->own.slot != slot_on_air(c, slot);
    heard->sampled = slot - late;
    /* unknown agents, or a frame of another time (a replay) */
    if (late && (slot < 1 || e->own.slot != slot_on_air(c, slot - 1))) return HEARD_FOREIGN;
    if (e->own.sender > c->agents) return HEARD_FOREIGN;
    return !extended || known_ids(c->agents, e, heard->sampled) ? HEARD : HEARD_FOREIGN;
}

int table_take(dtsa_table *t, const heard_frame *heard)
{
    const extended_frame *e = &heard->e;
    const int k = e->own.sender - 1, wakes = !t->in_ap[k] && e->own.c_r;
    if (t->sent_slot[k] < heard->sampled) table_learn(t, &e->own, heard->sampled);
    if (t->config->profile == DTSA_PROFILE_EXTENDED && t->observer != k)
        for (int i = 0; i < e->gossip_count; i++)
            gossip_learn(t, heard->sampled - e->gossip[i].age, &e->gossip[i]);
    return wakes;
}

void agent_take(dtsa_agent *a, const heard_frame *heard)
{
    const int own = heard->e.own.sender - 1 == a->self;
    if (own && a->table->config->profile == DTSA_PROFILE_EXTENDED)
        return; /* it knows what it said */
    const int wakes = table_take(a->table, heard);
    if (a->policy->heard && !own) a->policy->heard(a, heard->sampled, &heard->e, wakes);
}

void agent_said(dtsa_agent *a, int64_t slot, const uint8_t *data, long length)
{
    dtsa_table *t = a->table;
    dtsa_frame f;
    if (t->sent_slot[a->self] == slot) return;
    if (a->decision.reason == DTSA_REASON_LEASE_OPEN) return; /* gossip says whether it was heard */
    if (frame_decode(data, length, t->config->position_step, &f) == FRAME_OK)
        table_learn(t, &f, slot);
}
