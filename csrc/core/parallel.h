// Loops over OpenMP's threads. A call of the kernel is one parallel region, and a loop is a task for each thread.
// Regions of `omp for` would wait at each loop's end until all threads had a processor; a call waits for that once, and
// a loop for tasks that began. Next to busy processes this halves the time of a step (docs/performance.md).
#pragma once

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <exception>
#include <functional>
#include <vector>

namespace edgegrad {

// It is thrown where a call is to stop.
struct Interrupted : std::exception {};

// The threads of one call of the kernel.
class ThreadTeam {
   public:
    // The calling thread alone asks `interrupted`, at most 20 times a second; null means never.
    explicit ThreadTeam(int threads, bool (*interrupted)() = nullptr)
        : threads_(std::max(1, threads)), interrupted_(interrupted) {}

    int threads() const { return threads_; }
    // Returns how many threads a loop takes. Waking one takes longer than a small item, so few items take one thread.
    int threads_for(int64_t items) const { return int(std::clamp<int64_t>(items, 1, threads_)); }

    // Calls work() on the calling thread, in a parallel region whose other threads take items of the loops within.
    void run(const std::function<void()>& work);
    // Throws Interrupted where the call is to stop. Long items call it from time to time.
    void check();

    // Calls item(thread, i) for i = 0 … n − 1, in no order, where thread < threads_for(n). It is compiled once: what a
    // loop does besides its items would otherwise be a large part of all code.
    void parallel_for_items(int64_t n, const std::function<void(int, int64_t)>& item);
    // Calls body(i) for i = 0 … n − 1, in no order.
    template <class Body>
    void parallel_for(int64_t n, Body body) {
        parallel_for_items(n, [&](int, int64_t i) { body(i); });
    }
    // Calls body(state, i) for i = 0 … n − 1, in no order, with a state for each thread. make() gives a pointer to it.
    template <class Make, class Body>
    void parallel_for_with_state(int64_t n, Make make, Body body) {
        std::vector<decltype(make())> states(threads_for(n));
        parallel_for_items(n, [&](int thread, int64_t i) {
            if (!states[thread]) states[thread] = make();
            body(*states[thread], i);
        });
    }
    // Calls body(k, first, last) for the blocks k of 0 … n − 1. The size of a block is fixed, so that sums over blocks
    // are rounded equally at any number of threads.
    static constexpr int64_t block = 4096;
    static int64_t blocks(int64_t n) { return (n + block - 1) / block; }
    template <class Body>
    void parallel_for_blocks(int64_t n, Body body) {
        parallel_for(blocks(n), [&](int64_t k) { body(k, k * block, std::min(n, (k + 1) * block)); });
    }
    // Returns what body(first, last) returns for each block, in their order. Each value is made on the thread's own
    // stack: threads that write next to one another in an array wait for each other's caches.
    template <class Body>
    auto map_blocks(int64_t n, Body body) {
        std::vector<decltype(body(n, n))> out(blocks(n));
        parallel_for_blocks(n, [&](int64_t k, int64_t first, int64_t last) { out[k] = body(first, last); });
        return out;
    }

   private:
    void guard(const std::function<void()>& work) noexcept;

    const int threads_;
    bool (*const interrupted_)();
    std::chrono::steady_clock::time_point last_check_ = std::chrono::steady_clock::now();
    std::atomic<bool> failed_{false};
    std::exception_ptr failure_;
};

}  // namespace edgegrad
