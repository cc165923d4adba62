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

#include <atomic>
#include <chrono>
#include <thread>

#include "core/parallel.h"

namespace edgegrad {

namespace nb = nanobind;

// Threads that called the kernel and still run, and those of them that wait for the end of the process.
inline std::atomic<int> callers{0}, waiting_callers{0};
inline std::atomic<bool> ending{false};
inline std::thread::id ending_thread;

struct Caller {
    Caller() { ++callers; }
    ~Caller() { --callers; }
};

inline void count_caller() { thread_local const Caller caller; }

// In the child of a fork() the thread that called it, through here, is the only one.
inline void forget_other_callers() { callers = 1, waiting_callers = 0; }

// Called by `atexit`, without the lock. A thread that rendered once and now waits for something else is not waited for
// any longer than this.
inline void await_callers() {
    count_caller();
    ++waiting_callers;
    ending_thread = std::this_thread::get_id();
    ending = true;
    const auto end = std::chrono::steady_clock::now() + std::chrono::milliseconds(500);
    while (callers > waiting_callers && std::chrono::steady_clock::now() < end)
        std::this_thread::sleep_for(std::chrono::milliseconds(1));
}

// Releases the interpreter's lock, and takes it again at the end.
class Unlocked {
   public:
    Unlocked() : state_(PyEval_SaveThread()) { count_caller(); }
    Unlocked(const Unlocked&) = delete;
    ~Unlocked() {
        if (ending && std::this_thread::get_id() != ending_thread) {
            // Not for ever: a handler called later may wait for this very thread.
            ++waiting_callers;
            std::this_thread::sleep_for(std::chrono::seconds(1));
            --waiting_callers;
        }
        try {
            PyEval_RestoreThread(state_);
        } catch (...) {  // the unwinding; if this were left, the process would be ended
            for (;;) std::this_thread::sleep_for(std::chrono::hours(1));
        }
    }

   private:
    PyThreadState* const state_;
};

// Whether a signal handler of Python raised, as that of Ctrl-C does.
inline bool interrupted() {
    nb::gil_scoped_acquire acquire;
    return PyErr_CheckSignals() != 0;
}

// Handlers run in the main thread alone; in others asking would only wait for the lock.
inline bool in_main_thread() {
    const nb::object main = nb::module_::import_("threading").attr("main_thread")();
    return nb::cast<unsigned long>(main.attr("ident")) == PyThread_get_thread_ident();
}

// Calls f(team) without the interpreter's lock.
template <class F>
auto unlocked(int threads, F f) {
    const auto ask = in_main_thread() ? interrupted : nullptr;
    try {
        const Unlocked release;
        Team team(threads, ask);
        return f(team);
    } catch (const Interrupted&) {
        throw nb::python_error();  // that of the handler
    }
}

}  // namespace edgegrad
