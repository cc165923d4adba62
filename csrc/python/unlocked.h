// Runs work without the interpreter's lock, and handles the end of the process meanwhile.
//
// Once the interpreter shuts down, only the main thread still gets its lock. Before 3.14, Python ends a thread that
// asks for it by unwinding its stack. A C++ frame that lets nothing through, in nanobind or in torch, then calls
// std::terminate(). Two things protect threads that render in a loop from this:
//   - where the kernel asks, the unwinding is caught, and the thread sleeps as long as the process lives;
//   - a handler of Python's `atexit` first gives such threads time to enter the kernel and to wait there; no operator
//     of torch then asks for the lock.
#pragma once

#include <nanobind/nanobind.h>

#include <functional>
#include <optional>
#include <type_traits>
#include <utility>

#include "core/parallel.h"

namespace edgegrad {

namespace nb = nanobind;

// Marks the thread that called fork() as the only caller; the child calls it.
void forget_other_callers();

// Waits for other callers; `atexit` calls it without the lock. It waits at most half a second for a thread that
// rendered once and now waits for something else.
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

// Does the same, and returns the result of f.
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
