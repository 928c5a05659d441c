/* Kills a part of a run between creating a file and setting its size, for tests/processes/half_made.rs: the part
   KILLED_PART at its KILLED_AT-th ftruncate. The part `launcher` is the program that runs the scene. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/types.h>
#include <unistd.h>

static int is_chosen(void) {
    const char *part = getenv("KILLED_PART");
    char words[4096];
    FILE *line = fopen("/proc/self/cmdline", "r");
    if (!part || !line) return 0;
    size_t count = fread(words, 1, sizeof words - 1, line);
    fclose(line);
    words[count] = 0;
    if (!strcmp(part, "launcher")) return strlen(words) + 1 < count && !strcmp(words + strlen(words) + 1, "run");
    for (size_t at = strlen(words) + 1; at < count; at += strlen(words + at) + 1)
        if (!strcmp(words + at, "proc")) return !strcmp(words + at + strlen("proc") + 1, part);
    return 0;
}

static void count_call(void) {
    static int calls;
    const char *killed_at = getenv("KILLED_AT");
    if (killed_at && is_chosen() && __sync_add_and_fetch(&calls, 1) == atoi(killed_at)) raise(SIGKILL);
}

int ftruncate(int file, off_t length) {
    int (*next)(int, off_t) = (int (*)(int, off_t))dlsym(RTLD_NEXT, "ftruncate");
    count_call();
    return next(file, length);
}

int ftruncate64(int file, off64_t length) {
    int (*next)(int, off64_t) = (int (*)(int, off64_t))dlsym(RTLD_NEXT, "ftruncate64");
    count_call();
    return next(file, length);
}
