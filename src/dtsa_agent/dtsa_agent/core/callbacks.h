/* What C calls in Python (core/station.py); the context is a handle of a Station. */
void station_prepare(void *context, int64_t slot, int hovers);
int station_open(void *context, int64_t slot, int hovers, uint8_t *frame, int *chosen);
int station_hear(void *context, int64_t slot, const uint8_t *frame, long length);
void station_unsent(void *context);
void station_close(void *context, int64_t slot);
void station_restart(void *context);
int station_leave(void *context);
int station_on_probation(void *context);
void station_opened(void *context, int64_t slot, int64_t start_ns, int64_t now_ns, int is_first);
void station_restarted(void *context, int64_t slot);
void station_heard(void *context, int sender, int64_t slot, const uint8_t *datagram, int length,
                   int64_t arrival_ns, int accepted);
void station_refused(void *context, int verdict, const uint8_t *datagram, long length,
                     int64_t arrival_ns);
void live_called(void *context, const live_call *call);
