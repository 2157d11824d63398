/* Faults in the calls that change a disk, below one folder: for tests/long/output_faults.py, by LD_PRELOAD.

   fault_arm(root, at, kind, error, sticky) counts the calls that change something below root; call number `at`
   (from 1) fails with `error`, or ends the process: before the call (kind 1), after it, or in the middle of a write
   (kind 2). With `sticky` every later call that takes space fails, too. fault_count() is the number of calls so far. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/types.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>

enum { NOTHING, BEFORE, AFTER, FAIL, COMMAND };
static char root[PATH_MAX], command[PATH_MAX];
static long count, at;
static int kind, error_number, sticky, busy;

void fault_arm(const char *folder, long number, int what, int error, int keep, const char *shell) {
    strncpy(root, folder, PATH_MAX - 1);
    strncpy(command, shell, PATH_MAX - 1);
    count = 0, at = number, kind = what, error_number = error, sticky = keep, busy = 0;
}
long fault_count(void) { return count; }

static int below(const char *path) {
    size_t n = strlen(root);
    return n && !busy && path && strncmp(path, root, n) == 0 && (path[n] == '/' || path[n] == 0);
}
static int below_fd(int fd) {
    char name[64], path[PATH_MAX];
    if (!root[0] || busy) return 0;
    snprintf(name, sizeof name, "/proc/self/fd/%d", fd);
    ssize_t n = readlink(name, path, sizeof path - 1);
    if (n <= 0) return 0;
    path[n] = 0;
    return below(path);
}
/* What happens to this call: NOTHING, FAIL (errno is set), or AFTER (let it happen, then die). */
static int fate(int takes_space) {
    count++;
    if (count == at && kind == BEFORE) kill(getpid(), SIGKILL);
    if (count == at && kind == AFTER) return AFTER;
    if (count == at && kind == COMMAND) {
        busy = 1;
        if (system(command)) {}
        busy = 0;
        return NOTHING;
    }
    if (kind == FAIL && (count == at || (sticky && count > at && takes_space))) {
        errno = error_number;
        return FAIL;
    }
    return NOTHING;
}
static void die(void) { kill(getpid(), SIGKILL); }

#define REAL(result, name, ...) \
    static result (*real)(__VA_ARGS__); \
    if (!real) real = (result (*)(__VA_ARGS__))dlsym(RTLD_NEXT, name)
#define GUARD(result, hit, space, call) \
    if (hit) { \
        int f = fate(space); \
        if (f == FAIL) return -1; \
        result r = call; \
        if (f == AFTER) die(); \
        return r; \
    } \
    return call

ssize_t write(int fd, const void *data, size_t n) {
    REAL(ssize_t, "write", int, const void *, size_t);
    if (below_fd(fd)) {
        int f = fate(1);
        if (f == FAIL) return -1;
        if (f == AFTER) { if (real(fd, data, n / 2)) {} die(); }
    }
    return real(fd, data, n);
}
ssize_t pwrite64(int fd, const void *data, size_t n, off64_t where) {
    REAL(ssize_t, "pwrite64", int, const void *, size_t, off64_t);
    GUARD(ssize_t, below_fd(fd), 1, real(fd, data, n, where));
}
ssize_t pwrite(int fd, const void *data, size_t n, off_t where) {
    REAL(ssize_t, "pwrite", int, const void *, size_t, off_t);
    GUARD(ssize_t, below_fd(fd), 1, real(fd, data, n, where));
}
ssize_t writev(int fd, const struct iovec *parts, int n) {
    REAL(ssize_t, "writev", int, const struct iovec *, int);
    GUARD(ssize_t, below_fd(fd), 1, real(fd, parts, n));
}
static int opens(const char *name, const char *path, int flags, mode_t mode) {
    return ((int (*)(const char *, int, mode_t))dlsym(RTLD_NEXT, name))(path, flags, mode);
}
#define OPEN(name) \
    int name(const char *path, int flags, ...) { \
        mode_t mode = 0; \
        if (flags & O_CREAT) { va_list more; va_start(more, flags); mode = va_arg(more, mode_t); va_end(more); } \
        GUARD(int, (flags & (O_CREAT | O_TRUNC)) && below(path), 1, opens(#name, path, flags, mode)); \
    }
OPEN(open)
OPEN(open64)
int rename(const char *a, const char *b) {
    REAL(int, "rename", const char *, const char *);
    GUARD(int, below(a) || below(b), 0, real(a, b));
}
int renameat2(int x, const char *a, int y, const char *b, unsigned flags) {
    REAL(int, "renameat2", int, const char *, int, const char *, unsigned);
    GUARD(int, below(a) || below(b), 0, real(x, a, y, b, flags));
}
int link(const char *a, const char *b) {
    REAL(int, "link", const char *, const char *);
    GUARD(int, below(b), 1, real(a, b));
}
int linkat(int x, const char *a, int y, const char *b, int flags) {
    REAL(int, "linkat", int, const char *, int, const char *, int);
    GUARD(int, below(b), 1, real(x, a, y, b, flags));
}
int unlink(const char *path) {
    REAL(int, "unlink", const char *);
    GUARD(int, below(path), 0, real(path));
}
int rmdir(const char *path) {
    REAL(int, "rmdir", const char *);
    GUARD(int, below(path), 0, real(path));
}
int mkdir(const char *path, mode_t mode) {
    REAL(int, "mkdir", const char *, mode_t);
    GUARD(int, below(path), 1, real(path, mode));
}
int chmod(const char *path, mode_t mode) {
    REAL(int, "chmod", const char *, mode_t);
    GUARD(int, below(path), 0, real(path, mode));
}
int fchmod(int fd, mode_t mode) {
    REAL(int, "fchmod", int, mode_t);
    GUARD(int, below_fd(fd), 0, real(fd, mode));
}
int fsync(int fd) {
    REAL(int, "fsync", int);
    GUARD(int, below_fd(fd), 1, real(fd));
}
int ftruncate64(int fd, off64_t n) {
    REAL(int, "ftruncate64", int, off64_t);
    GUARD(int, below_fd(fd), 0, real(fd, n));
}
