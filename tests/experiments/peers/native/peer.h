/* What a peer in C or C++ offers to src/bin/native.rs, which measures it. */
#ifndef CARA_PEER_H
#define CARA_PEER_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Starts to serve in threads of its own, and calls `executed` for each message that wants no answer. `run` differs from
 * that of all other servers. Returns what callers need to find it, without line breaks, or null. */
const char *peer_serve(uint32_t run, void (*executed)(void));

/* A caller that is ready to call, for one thread at a time, or null. May be asked from several threads. */
void *peer_connect(uint32_t run, const char *address);

/* Sends `text`, which ends with a zero behind `length`, there and back; the length that came back, or -1. */
long peer_echo(void *caller, const char *text, size_t length);

/* Sends it one way; 0, or anything else where it was not taken. */
int peer_send(void *caller, const char *text, size_t length);

/* Why the last call of this thread failed. */
const char *peer_error(void);

#ifdef __cplusplus
}

#include <exception>
#include <string>

/* Runs `work`; its exception becomes the text of peer_error, and `failed` the result. */
inline std::string &peer_last_error() {
    static thread_local std::string error;
    return error;
}

template <typename Result, typename Work>
Result peer_guard(Result failed, Work work) {
    try {
        return work();
    } catch (const std::exception &error) {
        peer_last_error() = error.what();
    } catch (...) {
        peer_last_error() = "an exception without a text";
    }
    return failed;
}
#endif
#endif
