// Loops shared among OpenMP's threads. The runtime is torch's, which is loaded before the kernel: torch and the kernel
// use the same threads, one after the other.
#include "core/parallel.h"

#include <omp.h>

#include <condition_variable>
#include <system_error>

#if defined(__x86_64__) || defined(_M_X64)
#include <immintrin.h>
#endif
#ifndef _WIN32
#include <dlfcn.h>
#endif
#ifdef __SANITIZE_THREAD__
#include <sanitizer/tsan_interface.h>
#endif

namespace edgegrad {

namespace {

// Long enough for threads that finish together; short beside what other processes would miss.
constexpr std::chrono::microseconds spin_time(100);
constexpr std::chrono::milliseconds asking_time(50);

// Waits a little without sleep: whether `ready` came true.
template <class Ready>
bool spin(Ready ready) {
    const auto end = std::chrono::steady_clock::now() + spin_time;
    do {
        for (int k = 0; k < 16; ++k) {
            if (ready()) return true;
#if defined(__x86_64__) || defined(_M_X64)
            _mm_pause();
#else
            std::this_thread::yield();
#endif
        }
    } while (std::chrono::steady_clock::now() < end);
    return false;
}

// A loop whose items are taken one by one by the threads of a team. The caller waits for items that were taken, and asks
// meanwhile whether to stop; what is left then is OpenMP's own barrier, which other threads pass without work.
class Items {
   public:
    Items(int64_t n, const ItemBody& body) : n_(n), body_(body) {}

    // On each thread: takes items until none is left.
    void work(int thread) {
        for (int64_t i; (i = next_.fetch_add(1, std::memory_order_relaxed)) < n_;) {
            body_(thread, i);
            const bool last = done_.fetch_add(1, std::memory_order_release) + 1 == n_;
            if (!last || thread == 0) continue;
            const std::lock_guard lock(mutex_);
            finished_.notify_one();
        }
    }

    // On the caller's thread, after its work.
    void wait(const std::function<void()>& waiting) {
        const auto finished = [this] { return done_.load(std::memory_order_acquire) == n_; };
        if (spin(finished)) return;
        std::unique_lock lock(mutex_);
        while (!finished_.wait_for(lock, asking_time, finished)) {
            lock.unlock();
            waiting();
            lock.lock();
        }
    }

   private:
    const int64_t n_;
    const ItemBody& body_;
    std::atomic<int64_t> next_{0}, done_{0};
    std::mutex mutex_;
    std::condition_variable finished_;
};

// ThreadSanitizer does not see how the runtime, which is not built with it, starts the threads of a region and waits for
// them: it is told.
#ifdef __SANITIZE_THREAD__
#define EDGEGRAD_UNSEEN __attribute__((no_sanitize_thread))
void release(Items& items) { __tsan_release(&items); }
void acquire(Items& items) { __tsan_acquire(&items); }
#else
#define EDGEGRAD_UNSEEN
void release(Items&) {}
void acquire(Items&) {}
#endif

// Lets threads sleep while they wait, ours and torch's. Those of GNU's OpenMP spin for milliseconds between two regions,
// and so take processors from other processes and from each other; but a hundred turns only where the process has more
// of them than processors, as its manual says of GOMP_SPINCOUNT. So one thread makes as many as there are processors,
// which sleep for good. LLVM's and Intel's OpenMP, which answer to GNU's names too, have rules of their own: there
// nothing is done. Where OMP_THREAD_LIMIT allows no more threads, they spin. It changes how threads wait and no result.
// A system that has not so many threads to give ends the process, as it would for any region.
bool calm_openmp() {
#ifdef __linux__
    if (dlsym(RTLD_DEFAULT, "__kmpc_fork_call")) return false;  // not GNU's
    try {
        std::thread([] {
#pragma omp parallel num_threads(std::max(2u, std::thread::hardware_concurrency()))
            {
            }
            for (;;) std::this_thread::sleep_for(std::chrono::hours(1));
        }).detach();
    } catch (const std::system_error&) {
    }
#endif
    return true;
}

[[maybe_unused]] const bool calm = calm_openmp();

// In a forked child to which the runtime would not start threads: it would wait for those that the parent had.
bool alone = false;

}  // namespace

EDGEGRAD_UNSEEN void share(int64_t n, int threads, const ItemBody& body, const std::function<void()>& waiting) {
    Items items(n, body);
    if (alone) return items.work(0);
    release(items);
#pragma omp parallel num_threads(threads)
    {
        acquire(items);
        const int thread = omp_get_thread_num();
        items.work(thread);
        if (thread == 0) items.wait(waiting);
        release(items);
    }
    acquire(items);
}

namespace {

bool ended = false;  // the runtime's threads, before the fork

}  // namespace

void before_fork_of_workers() {
#ifdef __linux__
    // In the child GNU's OpenMP would wait for the threads that this one had; it starts new ones where there are none. Looked
    // up by name: the oldest torch may bring a runtime of before OpenMP 5.0. Refused within a region, as where a signal
    // handler forks.
    constexpr int omp_pause_hard = 2;
    void* const pause = dlsym(RTLD_DEFAULT, "omp_pause_resource_all");
    ended = pause && reinterpret_cast<int (*)(int)>(pause)(omp_pause_hard) == 0;
#else
    ended = true;  // LLVM's OpenMP minds forks by itself
#endif
}

void after_fork_of_workers(bool child) {
    if (child && !ended) alone = true;
}

std::string openmp_runtime() {
#ifdef _WIN32
    return "vcomp140.dll";
#else
    Dl_info info;
    return dladdr(reinterpret_cast<void*>(&omp_get_thread_num), &info) && info.dli_fname ? info.dli_fname : "";
#endif
}

}  // namespace edgegrad
