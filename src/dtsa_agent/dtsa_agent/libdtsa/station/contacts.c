/* Whom an agent hears, which agents hear it, and whether it may fly: the quorum.
 *
 * Each datagram names some of the agents that its sender hears, in the order of ids, others each
 * time. An agent that is missing between two neighbours of such a list is not heard by its sender. A
 * lost datagram delays what is known; it makes nothing up. An agent hears this one as it has said
 * last; one that has not said counts as most of those that have.
 *
 * All agents of the swarm count that have not said that they leave, whether they are heard or not. */
#include "station.h"

/* Of lists of one name each, after which an agent that was not named is not heard. */
enum { CYCLES = 8 };

int dtsa_names_hear(const dtsa_named *names, int count, int most, int agent)
{
    for (int i = 0; i < count; i++)
        if (names[i].id == agent) return 1;
    if (count < most) return -1; /* the list is complete */
    for (int i = 0; i + 1 < count; i++) {
        const unsigned ahead = (unsigned)(agent - names[i].id) & 0xffff,
                       next = (unsigned)(names[i + 1].id - names[i].id) & 0xffff;
        if (ahead < next) return -1;
    }
    return 0;
}

void contacts_hear(dtsa_station *s, const dtsa_datagram *d)
{
    peer *p = &s->peers[d->sender - 1];
    const int names = s->settings.link.names;
    const frame_condition condition = frame_condition_of(d->frame);
    dtsa_named named[DTSA_NAMES_MAX];
    int count = 0;
    p->left = (uint8_t)condition.leaves;
    p->resting = condition.rests || condition.on_probation;
    if (!names) return;
    for (int i = 0; i < names; i++)
        if (d->names[i].id) named[count++] = d->names[i];
    p->unnamed++;
    int hears = dtsa_names_hear(named, count, names, s->settings.id);
    if (!hears && names == 1 && p->unnamed > CYCLES * (s->settings.agents - 1)) hears = -1;
    if (hears) p->hears_us = (int8_t)hears;
    if (hears > 0) p->unnamed = 0;
    if (hears < 0) delay_forget_report(s, p);
}

static int is_recent(const dtsa_station *s, const peer *p, int64_t when, int64_t now)
{
    return when != INT64_MIN && now - when <= (p->resting ? s->resting_ns : s->moving_ns);
}

int contacts_is_recent(const dtsa_station *s, const peer *p, int64_t now)
{
    return is_recent(s, p, p->heard_ns, now);
}

int contacts_hears(const dtsa_station *s, const peer *p, int64_t now)
{
    return !p->left && is_recent(s, p, p->near_ns, now);
}

static int needed(const dtsa_station *s, int others)
{
    const dtsa_station_settings *c = &s->settings;
    if (c->quorum >= 0) return c->quorum;
    if (c->quorum == DTSA_QUORUM_SHARE) {
        const double share = others * c->quorum_share - 1e-9;
        return (int)share + ((int)share < share);
    }
    return others > 1 ? others - 1 : others;
}

int contacts_have_quorum(dtsa_station *s, int64_t now)
{
    dtsa_station_status *n = &s->counts;
    int yes = 0, no = 0, silent = 0, unsaid = 0;
    n->others = n->hears = n->heard_by = n->both = 0;
    for (int k = 0; k < s->settings.agents; k++) {
        const peer *p = &s->peers[k];
        if (k == s->settings.id - 1 || p->left) continue;
        const int hears = contacts_hears(s, p, now);
        n->hears += hears;
        n->both += hears && p->hears_us > 0;
        unsaid += hears && !p->hears_us;
        yes += p->hears_us > 0;
        no += p->hears_us < 0;
        silent += !p->hears_us;
        n->others++;
    }
    n->heard_by = yes;
    if (!s->settings.link.names || yes > no) {
        n->heard_by += silent;
        n->both += unsaid;
    }
    if (s->refused_since != INT64_MIN && now - s->refused_since > 500000000) /* nothing leaves it */
        n->heard_by = n->both = 0;
    n->needed = needed(s, n->others);
    return n->both >= n->needed;
}
