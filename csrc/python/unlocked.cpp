#include "python/unlocked.h"

#include <atomic>
#include <chrono>
#include <thread>

namespace edgegrad {

namespace {

// These count threads that called the kernel and still run, and those that wait for the end of the process.
std::atomic<int> callers{0}, waiting_callers{0};
std::atomic<bool> ending{false};
std::thread::id ending_thread;

struct Caller {
    Caller() { ++callers; }
    ~Caller() { --callers; }
};

void count_caller() { thread_local const Caller caller; }

// Returns whether a Python signal handler raised, for example that of Ctrl-C.
bool interrupted() {
    nb::gil_scoped_acquire acquire;
    return PyErr_CheckSignals() != 0;
}

// Handlers run in the main thread alone; in others asking would only wait for the lock.
bool in_main_thread() {
    const nb::object main = nb::module_::import_("threading").attr("main_thread")();
    return nb::cast<unsigned long>(main.attr("ident")) == PyThread_get_thread_ident();
}

}  // namespace

void forget_other_callers() { callers = 1, waiting_callers = 0; }

void await_callers() {
    count_caller();
    ++waiting_callers;
    ending_thread = std::this_thread::get_id();
    ending = true;
    const auto end = std::chrono::steady_clock::now() + std::chrono::milliseconds(500);
    while (callers > waiting_callers && std::chrono::steady_clock::now() < end)
        std::this_thread::sleep_for(std::chrono::milliseconds(1));
}

Unlocked::Unlocked() : state_(PyEval_SaveThread()) { count_caller(); }

Unlocked::~Unlocked() {
    if (ending && std::this_thread::get_id() != ending_thread) {
        // The wait is limited, because a handler called later may wait for this very thread.
        ++waiting_callers;
        std::this_thread::sleep_for(std::chrono::seconds(1));
        --waiting_callers;
    }
    try {
        PyEval_RestoreThread(state_);
    } catch (...) {  // This catches the unwinding; leaving the frame would end the process.
        for (;;) std::this_thread::sleep_for(std::chrono::hours(1));
    }
}

void run_unlocked(int threads, const std::function<void(Team&)>& f) {
    const auto ask = in_main_thread() ? interrupted : nullptr;
    try {
        const Unlocked release;
        Team team(threads, ask);
        f(team);
    } catch (const Interrupted&) {
        throw nb::python_error();  // It is the handler's error.
    }
}

}  // namespace edgegrad
