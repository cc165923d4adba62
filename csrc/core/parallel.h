// Loops over OpenMP's threads, which wait for them in a parallel region that stays open (parallel.cpp): how many a loop
// is worth, and what happens when one of them fails.
//
// An exception must not leave a thread: the process would end. So bodies run under a guard, which keeps the first
// exception, lets the others finish early, and hands it on when all have. The same way out serves whoever wants to stop
// a long call: the thread that called the kernel asks from time to time.
#pragma once

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <exception>
#include <functional>
#include <memory>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

namespace edgegrad {

// Thrown where a call was asked to stop.
struct Interrupted : std::exception {
    const char* what() const noexcept override { return "interrupted"; }
};

// One item of a loop: body(thread, i), where the calling thread is thread 0.
using ItemBody = std::function<void(int, int64_t)>;

// Calls body(thread, i) once for each i = 0 … n − 1, in no order, on the calling thread and up to `threads` − 1
// workers. While the calling thread waits for what the others took, it calls waiting() 20 times a second. Neither may
// throw.
void share(int64_t n, int threads, const ItemBody& body, const std::function<void()>& waiting);

// To be called around fork(), in whose child there are no workers; they are started anew.
void before_fork_of_workers();
void after_fork_of_workers(bool child);

// The file of the OpenMP runtime that the workers are of.
std::string openmp_runtime();

// The threads of one call of the kernel.
class Team {
   public:
    // `interrupted` is asked by the calling thread alone, at most 20 times a second; null: never.
    explicit Team(int threads, bool (*interrupted)() = nullptr)
        : threads_(std::max(1, threads)), interrupted_(interrupted), caller_(std::this_thread::get_id()) {}

    int threads() const { return threads_; }

    // As many as there are items to share. Waking a thread takes longer than a small item, so few items take one.
    int threads_for(int64_t items) const { return int(std::clamp<int64_t>(items, 1, threads_)); }

    // Within long work: throws where the call is to stop.
    void check();

    // item(thread, i) for i = 0 … n − 1, in no order. Compiled once: what a loop does besides its items would otherwise
    // be a large part of all code.
    void run(int64_t n, const ItemBody& item);

    // body(i) for i = 0 … n − 1, in no order.
    template <class Body>
    void each(int64_t n, Body body) {
        run(n, [&](int, int64_t i) { body(i); });
    }

    // body(state, i) for i = 0 … n − 1, in no order, with a state for each thread: make() gives a pointer that owns it.
    template <class Make, class Body>
    void each_with(int64_t n, Make make, Body body) {
        std::vector<decltype(make())> states(threads_for(n));
        run(n, [&](int thread, int64_t i) {
            if (!states[thread]) states[thread] = make();
            body(*states[thread], i);
        });
    }

    // body(k, first, last) for the blocks k of 0 … n − 1. Their size is fixed, so that sums over them are rounded
    // equally at any number of threads.
    static constexpr int64_t block = 4096;
    static int64_t blocks(int64_t n) { return (n + block - 1) / block; }
    template <class Body>
    void each_block(int64_t n, Body body) {
        each(blocks(n), [&](int64_t k) { body(k, k * block, std::min(n, (k + 1) * block)); });
    }
    // What body(first, last) returns for each block, in their order. Each is made on the thread's own stack: threads
    // that write next to one another in an array wait for each other's caches.
    template <class Body>
    auto of_blocks(int64_t n, Body body) {
        std::vector<decltype(body(n, n))> out(blocks(n));
        each_block(n, [&](int64_t k, int64_t first, int64_t last) { out[k] = body(first, last); });
        return out;
    }

   private:
    template <class F>
    void guard(F f) noexcept;

    const int threads_;
    bool (*const interrupted_)();
    const std::thread::id caller_;
    std::chrono::steady_clock::time_point asked_ = std::chrono::steady_clock::now();
    std::atomic<bool> failed_{false};
    std::mutex mutex_;
    std::exception_ptr failure_;
};

}  // namespace edgegrad
