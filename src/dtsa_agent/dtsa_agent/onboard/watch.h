/* Records what happens to an agent on board, in the laboratory; on a vehicle nothing does. */
#ifndef DTSA_WATCH_H
#define DTSA_WATCH_H

#include "dtsa_station.h"

#ifdef PEER_LAB
void observe(dtsa_station *station, dtsa_agent *agent);
#else
static inline void observe(dtsa_station *station, dtsa_agent *agent)
{
    (void)station;
    (void)agent;
}
#endif

#endif
