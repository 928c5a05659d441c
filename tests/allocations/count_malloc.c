/* Counts the calls of the C allocator, from C, C++ or Rust, in a process with this library in LD_PRELOAD. The count is in
 * the first eight bytes of the file TRABECULA_MALLOC_COUNTS/<pid>. */
#define _GNU_SOURCE
#include <fcntl.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <unistd.h>

extern void *__libc_malloc(size_t size);
extern void *__libc_calloc(size_t count, size_t size);
extern void *__libc_realloc(void *memory, size_t size);
extern void *__libc_memalign(size_t alignment, size_t size);
extern void __libc_free(void *memory);

static uint64_t nowhere;
static uint64_t *calls = &nowhere;

static void one_more(void)
{
    __atomic_fetch_add(calls, 1, __ATOMIC_RELAXED);
}

__attribute__((constructor)) static void begin(void)
{
    const char *folder = getenv("TRABECULA_MALLOC_COUNTS");
    char path[512];
    if (!folder || snprintf(path, sizeof path, "%s/%d", folder, (int)getpid()) >= (int)sizeof path)
        return;
    int file = open(path, O_RDWR | O_CREAT | O_CLOEXEC, 0600);
    if (file < 0 || ftruncate(file, sizeof *calls) != 0)
        return;
    void *map = mmap(NULL, sizeof *calls, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    close(file);
    if (map != MAP_FAILED)
        calls = map;
}

void *malloc(size_t size)
{
    one_more();
    return __libc_malloc(size);
}

void *calloc(size_t count, size_t size)
{
    one_more();
    return __libc_calloc(count, size);
}

void *realloc(void *memory, size_t size)
{
    one_more();
    return __libc_realloc(memory, size);
}

void *memalign(size_t alignment, size_t size)
{
    one_more();
    return __libc_memalign(alignment, size);
}

void *aligned_alloc(size_t alignment, size_t size)
{
    one_more();
    return __libc_memalign(alignment, size);
}

int posix_memalign(void **memory, size_t alignment, size_t size)
{
    one_more();
    *memory = __libc_memalign(alignment, size);
    return *memory ? 0 : 12;
}

void free(void *memory)
{
    if (memory)
        one_more();
    __libc_free(memory);
}
