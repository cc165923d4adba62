// Work without the interpreter's lock, and the end of the process meanwhile.
//
// Once the interpreter shuts down, no thread but the main one gets its lock any more. Before 3.14 Python ends a thread
// that asks, by an unwinding of its stack; a C++ frame that lets nothing through, in nanobind or in torch, then calls
// std::terminate(). Two things keep threads that render in a loop from this:
//   - where the kernel asks, the unwinding is caught, and the thread sleeps for as long as there is a process;
//   - a handler of Python's `atexit` first gives such threads time to come into the kernel and to wait there, so that
//     the lock is not asked for by an operator of torch just then.
#pragma once

#include <nanobind/nanobind.h>

#include <functional>
#include <optional>
#include <type_traits>
#include <utility>

#include "core/parallel.h"

namespace edgegrad {

namespace nb = nanobind;

// In the child of a fork() the thread that called it, through here, is the only one.
void forget_other_callers();

// Called by `atexit`, without the lock. A thread that rendered once and now waits for something else is not waited for
// any longer than half a second.
void await_callers();

// Releases the interpreter's lock, and takes it again at the end.
class Unlocked {
   public:
    Unlocked();
    Unlocked(const Unlocked&) = delete;
    ~Unlocked();

   private:
    PyThreadState* const state_;
};

// Calls f(team) without the interpreter's lock.
void run_unlocked(int threads, const std::function<void(ThreadTeam&)>& f);

// What it returns.
template <class F>
auto unlocked(int threads, F f) {
    using Result = std::invoke_result_t<F, ThreadTeam&>;
    if constexpr (std::is_void_v<Result>) {
        run_unlocked(threads, [&](ThreadTeam& team) { f(team); });
    } else {
        std::optional<Result> out;
        run_unlocked(threads, [&](ThreadTeam& team) { out.emplace(f(team)); });
        return *std::move(out);
    }
}

}  // namespace edgegrad
