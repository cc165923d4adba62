#include "parallel.h"

#include <condition_variable>
#include <system_error>
#include <vector>

#if defined(_M_X64) || defined(__x86_64__)
#include <immintrin.h>
#endif

namespace edgegrad {

namespace {

// Long enough for a worker to be there for the next loop of the same pass, and short beside the slice of time that it
// would take from another thread on a busy machine.
constexpr std::chrono::microseconds spin_time(100);
constexpr std::chrono::milliseconds asking_time(50);

// Whether `ready` came true within the time of spinning.
template <class Ready>
bool spin(Ready ready) {
    const auto end = std::chrono::steady_clock::now() + spin_time;
    do {
        for (int k = 0; k < 16; ++k) {
            if (ready()) return true;
#if defined(_M_X64) || defined(__x86_64__)
            _mm_pause();
#else
            std::this_thread::yield();
#endif
        }
    } while (std::chrono::steady_clock::now() < end);
    return false;
}

// Items that threads take one by one. The call waits for the items that were taken, not for threads: a worker that
// joined and then got no processor holds up nobody, and finds later that nothing is left.
class Job {
   public:
    Job(int64_t n, int places, const ItemBody& body) : places_(places), n_(n), body_(body) {}

    // Takes items until none is left. `body_` lives as long as one is not done.
    void work(int thread) {
        for (int64_t i; (i = next_.fetch_add(1, std::memory_order_relaxed)) < n_;) {
            body_(thread, i);
            if (done_.fetch_add(1, std::memory_order_acq_rel) + 1 < n_ || thread == 0) continue;
            const std::lock_guard lock(mutex_);
            finished_.notify_one();
        }
    }

    void wait(const std::function<void()>& waiting) {
        const auto done = [this] { return done_.load(std::memory_order_acquire) == n_; };
        if (spin(done)) return;
        std::unique_lock lock(mutex_);
        while (!finished_.wait_for(lock, asking_time, done)) {
            lock.unlock();
            waiting();
            lock.lock();
        }
    }

    // Of workers, which are threads 1, 2, …; guarded by the pool's mutex.
    int places_, joined_ = 0;

   private:
    const int64_t n_;
    const ItemBody& body_;
    std::atomic<int64_t> next_{0}, done_{0};
    std::mutex mutex_;
    std::condition_variable finished_;
};

// The workers, as many as any call asked for beside its own thread. All calls share them.
class Pool {
   public:
    void add(const std::shared_ptr<Job>& job) {
        int wake;
        {
            const std::lock_guard lock(mutex_);
            start_workers(job->places_);
            jobs_.push_back(job);
            places_ += job->places_;
            wake = std::min(sleeping_, places_ - spinning_);
        }
        for (; wake > 0; --wake) wake_.notify_one();
    }

    // No worker joins from now on.
    void remove(const Job* job) {
        const std::lock_guard lock(mutex_);
        remove_locked(job);
    }

    std::mutex mutex_;  // held around fork()

   private:
    void start_workers(int n) {
        try {
            for (; workers_ < n; ++workers_) std::thread([this] { run(); }).detach();
        } catch (const std::system_error&) {  // no more threads to be had: those that are there do all
        }
    }

    void remove_locked(const Job* job) {
        for (auto it = jobs_.begin(); it != jobs_.end(); ++it)
            if (it->get() == job) {
                places_ -= job->places_;
                jobs_.erase(it);
                return;
            }
    }

    void run() {
        std::unique_lock lock(mutex_);
        for (;;) {
            if (!jobs_.empty()) {
                const std::shared_ptr<Job> job = jobs_.front();
                const int thread = ++job->joined_;
                --places_;
                if (--job->places_ == 0) remove_locked(job.get());
                lock.unlock();
                job->work(thread);
                lock.lock();
                remove_locked(job.get());  // nothing is left of it
                continue;
            }
            ++spinning_;
            lock.unlock();
            spin([this] { return places_.load(std::memory_order_relaxed) > 0; });
            lock.lock();
            --spinning_;
            if (!jobs_.empty()) continue;
            ++sleeping_;
            wake_.wait(lock, [this] { return !jobs_.empty(); });
            --sleeping_;
        }
    }

    std::condition_variable wake_;
    std::vector<std::shared_ptr<Job>> jobs_;  // with places, the oldest first
    std::atomic<int> places_{0};              // of all of them
    int workers_ = 0, spinning_ = 0, sleeping_ = 0;
};

// Never destroyed: workers wait in it until the process is gone.
Pool* pool = new Pool;

}  // namespace

void share(int64_t n, int threads, const ItemBody& body, const std::function<void()>& waiting) {
    const auto job = std::make_shared<Job>(n, threads - 1, body);
    pool->add(job);
    job->work(0);
    pool->remove(job.get());
    job->wait(waiting);
}

void before_fork_of_workers() { pool->mutex_.lock(); }

void after_fork_of_workers(bool child) {
    if (child) pool = new Pool;  // without workers; the old one is as they left it
    else pool->mutex_.unlock();
}

}  // namespace edgegrad
