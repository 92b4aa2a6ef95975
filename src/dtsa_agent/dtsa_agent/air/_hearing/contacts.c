/* Whom an agent hears, who hears it, and who is there. */
#include "contacts.h"

#include "frame.h"

/* Of an extended frame, see frame_extended.c; others have c_r at the same place. */
enum { LEAVES = 255, MOVES = 1, PROBATION = 2 };

static int64_t larger(int64_t a, int64_t b) { return a > b ? a : b; }

void contacts_clear(contacts *c)
{
    for (int k = 0; k < c->agents; k++) c->of[k] = (contact){.heard = -1, .named = -1, .seen = -1};
    c->last = 0;
}

static int64_t limit_of(const contacts *c, const contact *one)
{
    return one->still ? c->resting : c->moving;
}

static int is_there(const contacts *c, const contact *one, int strict)
{
    const int64_t by_frame = (strict ? c->resting : limit_of(c, one)) + c->named,
                  by_name = (strict ? c->resting : 0) + c->named;
    return !one->left && ((one->heard >= 0 && c->last - one->heard <= by_frame) ||
                          (one->named >= 0 && c->last - one->named <= by_name));
}

void contacts_reset(contacts *c, int64_t slot)
{
    for (int k = 0; k < c->agents; k++) {
        contact *one = &c->of[k];
        *one = (contact){.heard = -1,
                         .named = is_there(c, one, 0) ? slot : -1,
                         .seen = one->seen,
                         .left = one->left};
    }
    c->last = 0;
}

void contacts_see(contacts *c, int sender, int64_t slot, int64_t now)
{
    contact *one = &c->of[sender - 1];
    if (slot <= one->seen) return; /* played again */
    one->seen = slot;
    if (!one->left) one->named = larger(one->named, now < 0 ? 0 : now);
}

/* 1: the sender of the list hears the agent, -1: it does not, 0: the list does not say. */
static int said_of(int agent, const int *names, int count, int peers)
{
    for (int i = 0; i < count; i++)
        if (names[i] == agent) return 1;
    if (count < peers) return -1; /* all whom it hears */
    for (int i = 0; i + 1 < count; i++) {
        const unsigned ahead = (unsigned)(agent - names[i]) & 0xffff,
                       next = (unsigned)(names[i + 1] - names[i]) & 0xffff;
        if (ahead < next) return -1;
    }
    return 0;
}

void contacts_hear(contacts *c, int sender, int64_t slot, const uint8_t *frame, const int *names,
                   int count)
{
    contact *one = &c->of[sender - 1];
    const int extended = (frame[0] & 0xf) == DTSA_PROFILE_EXTENDED;
    c->last = larger(c->last, slot);
    one->heard = larger(one->heard, slot);
    one->seen = larger(one->seen, slot);
    one->left = extended && frame[2] == LEAVES;
    one->probation = extended && (frame[3] & PROBATION);
    one->still = one->probation || !(extended ? frame[3] & MOVES : frame[3]);
    for (int i = 0; i < count; i++) {
        const int k = names[i] - 1;
        if (k >= 0 && k < c->agents && k != c->self && !c->of[k].left)
            c->of[k].named = larger(c->of[k].named, slot);
    }
    one->unnamed++;
    int says = said_of(c->self + 1, names, count, c->peers);
    if (!says && c->peers == 1 && one->unnamed > CYCLES * (c->agents - 1)) says = -1;
    if (says) one->says = (int8_t)says;
    if (says > 0) one->unnamed = 0;
    if (says < 0) {
        one->denied = slot;
        if (one->probation) one->says = 0; /* it is new, and has not heard all yet */
    }
}

int contacts_hears(const contacts *c, int index, int64_t slot)
{
    const contact *one = &c->of[index];
    return one->heard >= 0 && !one->left && slot - one->heard <= limit_of(c, one);
}

contact_count contacts_count(const contacts *c, int64_t slot, int strict)
{
    contact_count n = {0, 0, 0, 0};
    for (int k = 0; k < c->agents; k++) {
        const contact *one = &c->of[k];
        if (!is_there(c, one, strict) || (one->probation && !strict)) continue;
        const int old = one->says < 0 && slot - one->denied > c->named, says = old ? 0 : one->says;
        const int hears = contacts_hears(c, k, slot), by = says ? says > 0 : !strict || !c->peers;
        n.there++;
        n.hears += hears;
        n.heard_by += by;
        n.both += hears && by;
    }
    return n;
}
