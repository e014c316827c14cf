/* For User-Mode Linux before 6.13 on processors whose registers are wider than it knows.
 *
 * It keeps the extended state of a process (x87, SSE, AVX ...) in 2,696 bytes, and since AMX the
 * kernel takes no state that is not whole: the guest's first process dies. Preloaded, this takes
 * its part from the whole state, or puts it back into the whole, as a host without AMX would do.
 * The guest's processes cannot use what is left out: AMX must be asked for, by a system call that
 * the guest's kernel does not know.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/uio.h>

enum { MOST_BYTES = 1 << 16 };

typedef long (*ptrace_call)(enum __ptrace_request, pid_t, void *, void *);

static long of_extended_state(ptrace_call call, enum __ptrace_request request, pid_t process,
                              void *kind, struct iovec *part) {
  static __thread char bytes[MOST_BYTES];
  struct iovec whole = {bytes, sizeof bytes};
  long failed = call(PTRACE_GETREGSET, process, kind, &whole);
  if (failed) return failed;
  if (part->iov_len > whole.iov_len) part->iov_len = whole.iov_len;
  if (request == PTRACE_GETREGSET) {
    memcpy(part->iov_base, bytes, part->iov_len);
    return 0;
  }
  memcpy(bytes, part->iov_base, part->iov_len);
  return call(PTRACE_SETREGSET, process, kind, &whole);
}

long ptrace(enum __ptrace_request request, ...) {
  static ptrace_call call;
  if (!call) call = (ptrace_call)dlsym(RTLD_NEXT, "ptrace");
  va_list arguments;
  va_start(arguments, request);
  pid_t process = va_arg(arguments, pid_t);
  void *address = va_arg(arguments, void *);
  void *data = va_arg(arguments, void *);
  va_end(arguments);
  int of_registers = request == PTRACE_GETREGSET || request == PTRACE_SETREGSET;
  if (of_registers && address == (void *)NT_X86_XSTATE)
    return of_extended_state(call, request, process, address, data);
  return call(request, process, address, data);
}
