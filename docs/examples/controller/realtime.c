/* Real-time loop of Linux: at 10 kHz, with SCHED_FIFO and locked memory, it reads setpoints from shared memory and writes
 * voltages back. Usage: realtime NAME [PRIORITY] [STEPS]; `realtime /stage 80` runs until it is interrupted.
 * The writer of setpoints increments `written` before and after: an odd number means that it is writing. */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <sched.h>
#include <signal.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <time.h>
#include <unistd.h>

#include "slpi_inverse.h"

#define PERIOD_NS 100000L

typedef struct {
    atomic_uint written;             /* by the writer of setpoints; 0: none yet */
    double desired[SLPI_AXES];       /* m */
    atomic_uint answered;            /* by this loop, as above */
    double volts[SLPI_AXES];         /* V */
    atomic_uint refused, late;       /* steps that were refused, and that began more than a period late */
} shared_t;

static volatile sig_atomic_t ends;

static void end(int signal)
{
    (void)signal;
    ends = 1;
}

/* The setpoints, if they are whole: 1. */
static int read_setpoints(shared_t *shared, slpi_real *desired)
{
    const unsigned before = atomic_load_explicit(&shared->written, memory_order_acquire);
    double copy[SLPI_AXES];
    if (before == 0 || before % 2 != 0) {
        return 0;
    }
    memcpy(copy, shared->desired, sizeof copy);
    atomic_thread_fence(memory_order_acquire);
    if (atomic_load_explicit(&shared->written, memory_order_relaxed) != before) {
        return 0;
    }
    for (int i = 0; i < SLPI_AXES; i++) {
        desired[i] = (slpi_real)copy[i];
    }
    return 1;
}

static void write_voltages(shared_t *shared, const slpi_real *volts)
{
    atomic_fetch_add_explicit(&shared->answered, 1, memory_order_acq_rel);
    for (int i = 0; i < SLPI_AXES; i++) {
        shared->volts[i] = (double)volts[i];
    }
    atomic_fetch_add_explicit(&shared->answered, 1, memory_order_release);
}

int main(int count, char **words)
{
    const long steps = count > 3 ? atol(words[3]) : 0;
    const struct sched_param priority = {.sched_priority = count > 2 ? atoi(words[2]) : 80};
    static slpi_inverse_t inverse;
    slpi_real desired[SLPI_AXES], volts[SLPI_AXES];
    struct timespec next, now;
    long since = 0;
    int file, known = 0;
    shared_t *shared;
    if (count < 2 || (file = shm_open(words[1], O_RDWR | O_CREAT, 0600)) < 0 || ftruncate(file, sizeof *shared) != 0) {
        fprintf(stderr, "realtime: no shared memory; usage: realtime /NAME [PRIORITY] [STEPS]\n");
        return 1;
    }
    shared = mmap(NULL, sizeof *shared, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    if (shared == MAP_FAILED) {
        perror("realtime");
        return 1;
    }
    /* Without the permission it goes on, later at times. */
    if (mlockall(MCL_CURRENT | MCL_FUTURE) != 0 || sched_setscheduler(0, SCHED_FIFO, &priority) != 0) {
        fprintf(stderr, "realtime: %s: no real-time scheduling\n", strerror(errno));
    }
    signal(SIGINT, end);
    signal(SIGTERM, end);
    slpi_inverse_init(&inverse, NULL);
    clock_gettime(CLOCK_MONOTONIC, &next);
    for (long k = 0; !ends && (steps == 0 || k < steps); k++) {
        next.tv_nsec += PERIOD_NS;
        if (next.tv_nsec >= 1000000000L) {
            next.tv_nsec -= 1000000000L;
            next.tv_sec++;
        }
        while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &next, NULL) == EINTR && !ends) {
        }
        clock_gettime(CLOCK_MONOTONIC, &now);
        if ((now.tv_sec - next.tv_sec) * 1000000000L + now.tv_nsec - next.tv_nsec > PERIOD_NS) {
            atomic_fetch_add(&shared->late, 1);
        }
        known |= read_setpoints(shared, desired);
        since++;
        if (known) {
            /* The model's time is that of the plan, not of the jitter. */
            const slpi_real dt = (slpi_real)((double)since * PERIOD_NS * 1e-9);
            if (slpi_inverse_step(&inverse, dt, desired, volts) != SLPI_OK) {
                atomic_fetch_add(&shared->refused, 1);
            }
            since = 0;
            write_voltages(shared, volts);
        }
    }
    printf("%u late, %u refused\n", atomic_load(&shared->late), atomic_load(&shared->refused));
    return 0;
}
