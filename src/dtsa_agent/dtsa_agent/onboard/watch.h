/* Who is told what happens to an agent on board: the laboratory, where there is one. */
#ifndef DTSA_WATCH_H
#define DTSA_WATCH_H

#include "board.h"

extern const board_watch the_laboratory;

#ifdef PEER_LAB
#define WATCH (&the_laboratory)
#else
#define WATCH NULL
#endif

#endif
