/* Whom an agent hears, who hears it, and who is there. The same in plain Python: air/contacts.py. */
#ifndef DTSA_CONTACTS_H
#define DTSA_CONTACTS_H

#include <stdint.h>

enum { CYCLES = 8 };

typedef struct contact {
    int64_t heard, named; /* slot of its last frame, and in which others named it last; -1: none */
    int64_t denied;       /* slot in which it said last that it does not hear this agent */
    int64_t seen;         /* largest slot in a frame of its own, of whatever time; -1: none */
    int64_t unnamed;      /* its datagrams since it named this agent */
    uint8_t still, probation, left;
    int8_t says; /* 1: it hears this agent; -1: it does not; 0: it has not said */
} contact;

typedef struct contacts {
    int agents, self, peers;        /* number of agents, own index, names in a datagram */
    int64_t moving, resting, named; /* slots, see Limits */
    contact *of;                    /* (agents) */
    int64_t last;
} contacts;

typedef struct contact_count {
    int there, hears, heard_by, both;
} contact_count;

void contacts_clear(contacts *c);
void contacts_reset(contacts *c, int64_t slot); /* another time was taken over */
void contacts_see(contacts *c, int sender, int64_t slot, int64_t now); /* a frame of another time */
/* frame: at least 8 bytes; names: count ids. */
void contacts_hear(contacts *c, int sender, int64_t slot, const uint8_t *frame, const int *names,
                   int count);
int contacts_hears(const contacts *c, int index, int64_t slot);
contact_count contacts_count(const contacts *c, int64_t slot, int strict);

#endif
