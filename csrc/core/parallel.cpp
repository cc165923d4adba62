// The threads are OpenMP's, and the runtime is torch's, which is loaded before the kernel. They stay in one parallel
// region for good and take the loops of all calls from a queue. A region for each loop, or for each call, ends only
// when all of its threads had a processor, work or no work, and shares them with torch's operators: next to two busy
// processes a step took 1.5 to 2.3 times as long (docs/tried.md).
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

// Long enough to be there for the next loop of the same pass; short next to what other processes would miss.
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

// A loop whose items are taken one by one. The caller waits for items that were taken, not for threads: a worker that
// joined and then got no processor holds up nobody, and later finds that nothing is left.
class Job {
   public:
    Job(int64_t n, int places, const ItemBody& body) : places(places), n_(n), body_(body) {}

    // Takes items until none is left. What belongs to the caller is touched only while one is not done.
    void work(int thread) {
        for (int64_t i; (i = next_.fetch_add(1, std::memory_order_relaxed)) < n_;) {
            body_(thread, i);
            const bool last = done_.fetch_add(1, std::memory_order_release) + 1 == n_;
            if (!last || thread == 0) continue;
            const std::lock_guard lock(mutex_);
            finished_.notify_one();
        }
    }

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

    // Workers that may still join and that did: threads 1, 2, … Guarded by the mutex of the pool.
    int places, joined = 0;

   private:
    const int64_t n_;
    const ItemBody& body_;
    std::atomic<int64_t> next_{0}, done_{0};
    std::mutex mutex_;
    std::condition_variable finished_;
};

// ThreadSanitizer does not see how the runtime, which is not built with it, starts the threads of a region: it is told.
#ifdef __SANITIZE_THREAD__
#define EDGEGRAD_UNSEEN __attribute__((no_sanitize_thread))
void release(void* of) { __tsan_release(of); }
void acquire(void* of) { __tsan_acquire(of); }
#else
#define EDGEGRAD_UNSEEN
void release(void*) {}
void acquire(void*) {}
#endif

// The workers: as many as there are processors, or as a call asked for next to its own thread. Calls at the same time
// share them.
class Pool {
   public:
    void add(const std::shared_ptr<Job>& job) {
        int wake;
        {
            const std::lock_guard guard(mutex_);
            start_workers(job->places);
            jobs_.push_back(job);
            places_ += job->places;
            wake = std::min(sleeping_, places_ - spinning_);
        }
        for (; wake > 0; --wake) wake_.notify_one();
    }

    void start() {
        const std::lock_guard guard(mutex_);
        start_workers(std::max(1, int(std::thread::hardware_concurrency()) - 1));
    }

    // No worker joins it from now on.
    void remove(const Job& job) {
        const std::lock_guard guard(mutex_);
        drop(job);
    }

    void lock() { mutex_.lock(); }
    void unlock() { mutex_.unlock(); }

   private:
    void start_workers(int n) {
        if (workers_ >= n) return;
        try {
            std::thread([this, more = n - workers_, first = workers_ == 0] { open_region(more, first); }).detach();
            workers_ = n;
        } catch (const std::system_error&) {  // the system gives no more: those that there are do the work
        }
    }

    // The first region has no fewer threads than there are processors, for torch's sake: once a process has more
    // threads of GNU's OpenMP than processors, those that wait spin a hundred times and then sleep (its manual of
    // GOMP_SPINCOUNT); else they spin for milliseconds, and take processors from other processes and from each other.
    // Where the system has not so many threads to give, the runtime ends the process.
    EDGEGRAD_UNSEEN void open_region(int workers, bool first) {
        const int threads = first ? std::max({workers, int(std::thread::hardware_concurrency()), 2}) : workers;
        release(this);
#pragma omp parallel num_threads(threads)
        {
            acquire(this);
            if (omp_get_thread_num() < workers) run();
            for (;;) std::this_thread::sleep_for(std::chrono::hours(1));
        }
    }

    void drop(const Job& job) {
        const auto found = std::find_if(jobs_.begin(), jobs_.end(), [&](const auto& j) { return j.get() == &job; });
        if (found == jobs_.end()) return;
        places_ -= job.places;
        jobs_.erase(found);
    }

    void run() {
        std::unique_lock lock(mutex_);
        for (;;) {
            if (!jobs_.empty()) {
                const std::shared_ptr<Job> job = jobs_.front();
                const int thread = ++job->joined;
                --places_;
                if (--job->places == 0) drop(*job);
                lock.unlock();
                job->work(thread);
                lock.lock();
                drop(*job);  // nothing is left of it
                continue;
            }
            ++spinning_;
            lock.unlock();
            spin([this] { return places_.load(std::memory_order_relaxed) > 0; });
            lock.lock();
            --spinning_;
            ++sleeping_;
            wake_.wait(lock, [this] { return !jobs_.empty(); });
            --sleeping_;
        }
    }

    std::mutex mutex_;
    std::condition_variable wake_;
    std::vector<std::shared_ptr<Job>> jobs_;  // those with places, the oldest first
    std::atomic<int> places_{0};              // of all of them
    int workers_ = 0, spinning_ = 0, sleeping_ = 0;
};

// Never destroyed: workers wait in it until the process is gone.
Pool* pool = new Pool;

// At once, not with the first loop: torch's threads are to sleep from the first render on.
[[maybe_unused]] const bool started = (pool->start(), true);

}  // namespace

// Runs f unless the call is failing already; keeps what it throws.
template <class F>
void Team::guard(F f) noexcept {
    if (failed_.load(std::memory_order_relaxed)) return;
    try {
        f();
    } catch (...) {
        const std::lock_guard lock(mutex_);
        if (!failure_) failure_ = std::current_exception();
        failed_.store(true, std::memory_order_relaxed);
    }
}

void Team::check() {
    if (failed_.load(std::memory_order_relaxed)) throw Interrupted();
    if (!interrupted_ || std::this_thread::get_id() != caller_) return;
    const auto now = std::chrono::steady_clock::now();
    if (now - asked_ < asking_time) return;
    asked_ = now;
    if (interrupted_()) throw Interrupted();
}

void Team::run(int64_t n, const ItemBody& item) {
    check();
    const int threads = threads_for(n);
    const auto guarded = [&](int thread, int64_t i) {
        guard([&] {
            check();
            item(thread, i);
        });
    };
    if (threads > 1) share(n, threads, guarded, [&] { guard([&] { check(); }); });
    else
        for (int64_t i = 0; i < n; ++i) guarded(0, i);
    if (failed_) std::rethrow_exception(failure_);
}

void share(int64_t n, int threads, const ItemBody& body, const std::function<void()>& waiting) {
    const auto job = std::make_shared<Job>(n, threads - 1, body);
    pool->add(job);
    job->work(0);
    pool->remove(*job);
    job->wait(waiting);
}

void before_fork_of_workers() {
#ifdef __linux__
    // Torch's own too: in the child GNU's OpenMP would wait for the threads that the parent's had. It starts new ones
    // where there are none.
    constexpr int omp_pause_hard = 2;
    if (void* pause = dlsym(RTLD_DEFAULT, "omp_pause_resource_all"))
        reinterpret_cast<int (*)(int)>(pause)(omp_pause_hard);
#endif
    pool->lock();
}

void after_fork_of_workers(bool child) {
    if (child) pool = new Pool;  // the old one is as its threads left it, and may be locked for ever
    else pool->unlock();
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
