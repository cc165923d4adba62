#include "python/unlocked.h"

#include <atomic>
#include <chrono>
#include <semaphore>

namespace edgegrad {

namespace {

// These count threads that called the kernel and still run, and those that wait for the end of the process.
std::atomic<int> callers{0}, waiting_callers{0};
std::atomic<bool> ending{false};
thread_local bool ends_the_process = false;
// A caller that ends, or waits for the end of the process, releases `news`. Nobody releases `never`.
std::counting_semaphore<> news{0}, never{0};

struct Caller {
    Caller() { ++callers; }
    ~Caller() {
        --callers;
        if (ending) news.release();
    }
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
    ends_the_process = true;
    ending = true;
    const auto end = std::chrono::steady_clock::now() + std::chrono::milliseconds(500);
    while (callers > waiting_callers && news.try_acquire_until(end)) continue;
}

Unlocked::Unlocked() : state_(PyEval_SaveThread()) { count_caller(); }

Unlocked::~Unlocked() {
    if (ending && !ends_the_process) {
        // The wait is limited, because a handler called later may wait for this very thread.
        ++waiting_callers;
        news.release();
        never.try_acquire_for(std::chrono::seconds(1));
        --waiting_callers;
    }
    try {
        PyEval_RestoreThread(state_);
    } catch (...) {  // This catches the unwinding; leaving the frame would end the process.
        never.acquire();
    }
}

void run_unlocked(int threads, const std::function<void(ThreadTeam&)>& f) {
    const auto ask = in_main_thread() ? interrupted : nullptr;
    try {
        const Unlocked release;
        ThreadTeam team(threads, ask);
        team.run([&] { f(team); });
    } catch (const Interrupted&) {
        throw nb::python_error();  // raises the handler's error
    }
}

}  // namespace edgegrad
