/* Waits without an end that a library compiled with libstdc++ 9 or older asks for, and does not
 * get.
 *
 * There std::condition_variable::wait_until(steady_clock::time_point::max()) adds the difference of
 * two clocks to the largest time. It overflows; pthread_cond_timedwait refuses the negative time
 * without giving the mutex free, and is asked again, for ever: who should be waited for waits for
 * the mutex. Fast DDS does that when a participant is removed while another one is noticed to come
 * or go. Here such a wait is one without an end.
 *
 * Upstream: Fast DDS, issue 6513.
 * Delete when: the wheels' Fast DDS is compiled with libstdc++ 10 or newer, or waits without a
 * limit where it has none. `test_endless.py` shows the defect. */
#define _GNU_SOURCE
#define Py_LIMITED_API 0x030A0000
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <link.h>
#include <pthread.h>
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>

static int wait_until(pthread_cond_t *condition, pthread_mutex_t *mutex,
                      const struct timespec *until)
{
    if (until->tv_sec < 0) return pthread_cond_wait(condition, mutex);
    return pthread_cond_timedwait(condition, mutex, until);
}

typedef struct {
    const char *library; /* part of its file's name */
    int places;          /* where it calls us now */
} search;

/* Puts our function into one place of a library's table of functions; whether that could be done.
 */
static int put(void **place)
{
    const uintptr_t size = (uintptr_t)sysconf(_SC_PAGESIZE), page = (uintptr_t)place & ~(size - 1);
    if (__atomic_load_n(place, __ATOMIC_ACQUIRE) == (void *)wait_until) return 1;
    if (mprotect((void *)page, size, PROT_READ | PROT_WRITE)) return 0;
    __atomic_store_n(place, (void *)wait_until, __ATOMIC_RELEASE);
    return 1;
}

static int look(struct dl_phdr_info *info, size_t size, void *into)
{
    search *found = into;
    const ElfW(Dyn) *entry = NULL;
    ElfW(Addr) symbols = 0, names = 0, calls = 0, length = 0, kind = 0;
    (void)size;
    if (!strstr(info->dlpi_name, found->library)) return 0;
    for (int i = 0; i < info->dlpi_phnum; i++) {
        const ElfW(Phdr) *part = info->dlpi_phdr + i;
        if (part->p_type == PT_DYNAMIC) entry = (const void *)(info->dlpi_addr + part->p_vaddr);
    }
    for (; entry && entry->d_tag != DT_NULL; entry++) {
        if (entry->d_tag == DT_SYMTAB) symbols = entry->d_un.d_ptr;
        if (entry->d_tag == DT_STRTAB) names = entry->d_un.d_ptr;
        if (entry->d_tag == DT_JMPREL) calls = entry->d_un.d_ptr;
        if (entry->d_tag == DT_PLTRELSZ) length = entry->d_un.d_val;
        if (entry->d_tag == DT_PLTREL) kind = entry->d_un.d_val;
    }
    /* Only where the loader has made addresses of these, and entries are as on all 64-bit machines.
     */
    if (kind != DT_RELA || sizeof(void *) != 8 || symbols < info->dlpi_addr ||
        names < info->dlpi_addr || calls < info->dlpi_addr)
        return 0;
    for (const ElfW(Rela) *call = (const void *)calls; (ElfW(Addr))call < calls + length; call++) {
        const ElfW(Sym) *symbol = (const ElfW(Sym) *)symbols + ELF64_R_SYM(call->r_info);
        if (strcmp((const char *)names + symbol->st_name, "pthread_cond_timedwait") == 0)
            found->places += put((void **)(info->dlpi_addr + call->r_offset));
    }
    return 0;
}

static PyObject *mend(PyObject *self, PyObject *name)
{
    PyObject *bytes = PyUnicode_EncodeFSDefault(name);
    search found = {0};
    (void)self;
    if (!bytes) return NULL;
    found.library = PyBytes_AsString(bytes);
    if (found.library && *found.library) dl_iterate_phdr(look, &found);
    Py_DECREF(bytes);
    return PyLong_FromLong(found.places);
}

static PyMethodDef methods[] = {
    {"mend", mend, METH_O,
     "mend(library, /): number of places in which a library that is loaded calls us now"},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT,
    "_endless",
    "Waits without an end, in libraries that have them wrong",
    -1,
    methods,
    NULL,
    NULL,
    NULL,
    NULL,
};

PyMODINIT_FUNC PyInit__endless(void) { return PyModule_Create(&module); }
