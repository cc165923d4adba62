#include "core/parallel.h"

#include <omp.h>

#include <thread>

#include "core/thread_sanitizer.h"

namespace edgegrad {

// Runs `work` unless the call is failing already. An exception must not leave a thread, for the process would end: the
// first one is kept, and items that did not begin are left out.
void ThreadTeam::guard(const std::function<void()>& work) noexcept {
    if (failed_.load(std::memory_order_relaxed)) return;
    try {
        work();
    } catch (...) {
        if (!failed_.exchange(true)) failure_ = std::current_exception();
    }
}

void ThreadTeam::check() {
    if (failed_.load(std::memory_order_relaxed)) throw Interrupted();
    if (!interrupted_ || omp_get_thread_num() != 0) return;
    const auto now = std::chrono::steady_clock::now();
    if (now - last_check_ < std::chrono::milliseconds(50)) return;
    last_check_ = now;
    if (interrupted_()) throw Interrupted();
}

void ThreadTeam::run(const std::function<void()>& work) {
#if _OPENMP >= 200805  // MSVC's, which is older, has no tasks, so each loop is a region
#pragma omp parallel num_threads(threads_) if (threads_ > 1)
#pragma omp master
#endif
    guard(work);
    if (failed_) std::rethrow_exception(failure_);
}

EDGEGRAD_UNSEEN void ThreadTeam::parallel_for_items(int64_t n, const std::function<void(int, int64_t)>& item) {
    check();
#if _OPENMP >= 200805
    if (threads_for(n) > 1 && omp_get_level() == 0) return run([&] { parallel_for_items(n, item); });
    std::atomic<int64_t> next{0};
    std::atomic<int> at_work{0};
    const auto take_items = [&](int thread) {
        __tsan_acquire(&next);
        at_work.fetch_add(1, std::memory_order_relaxed);
        for (int64_t i; (i = next.fetch_add(1, std::memory_order_relaxed)) < n;)
            guard([&] { check(), item(thread, i); });
        at_work.fetch_sub(1, std::memory_order_release);
        __tsan_release(&next);
    };
    __tsan_release(&next);
    for (int thread = 1; thread < threads_for(n); ++thread) {
#pragma omp task firstprivate(thread)
        take_items(thread);
    }
    take_items(0);
    // The calling thread asks for signals also while others do the last items.
    for (; at_work.load(std::memory_order_acquire) > 0; std::this_thread::yield()) guard([&] { check(); });
#pragma omp taskwait
    __tsan_acquire(&next);
#else
#pragma omp parallel for schedule(dynamic) num_threads(threads_for(n))
    for (int64_t i = 0; i < n; ++i) guard([&] { check(), item(omp_get_thread_num(), i); });
#endif
    if (failed_) std::rethrow_exception(failure_);
}

}  // namespace edgegrad
