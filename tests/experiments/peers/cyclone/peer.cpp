// Cyclone DDS: a request topic, a reply topic for each caller, and a topic for what wants no answer; all reliable, with
// all history, on the loopback interface and without multicast.

#include <unistd.h>

#include <cstring>
#include <map>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <string>
#include <thread>

#include <dds/dds.h>

#include "../native/peer.h"
#include "echo.h"

namespace {

using Text = cara_peers_Message;

constexpr dds_duration_t PATIENCE = DDS_SECS(20);

dds_entity_t checked(dds_entity_t entity) {
    if (entity < 0) throw std::runtime_error(dds_strretcode(-entity));
    return entity;
}

// Domains of other pairs differ in most cases; where they do not, the names of the topics still do.
dds_entity_t participant(uint32_t run) {
    const char *config = "<Domain><General><Interfaces><NetworkInterface name='lo'/></Interfaces>"
                         "<AllowMulticast>false</AllowMulticast></General>"
                         "<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>20</MaxAutoParticipantIndex>"
                         "<Peers><Peer address='127.0.0.1'/></Peers></Discovery></Domain>";
    dds_domainid_t domain = 1 + run % 200;
    checked(dds_create_domain(domain, config));
    return checked(dds_create_participant(domain, nullptr, nullptr));
}

std::unique_ptr<dds_qos_t, decltype(&dds_delete_qos)> reliable() {
    std::unique_ptr<dds_qos_t, decltype(&dds_delete_qos)> qos(dds_create_qos(), dds_delete_qos);
    dds_qset_reliability(qos.get(), DDS_RELIABILITY_RELIABLE, PATIENCE);
    dds_qset_history(qos.get(), DDS_HISTORY_KEEP_ALL, DDS_LENGTH_UNLIMITED);
    return qos;
}

struct Topics {
    dds_entity_t participant;
    std::string run;

    dds_entity_t topic(const std::string &name) const {
        std::string full = name + "_" + run;
        return checked(dds_create_topic(participant, &cara_peers_Message_desc, full.c_str(), nullptr, nullptr));
    }
    dds_entity_t writer(const std::string &name) const {
        return checked(dds_create_writer(participant, topic(name), reliable().get(), nullptr));
    }
    dds_entity_t reader(const std::string &name) const {
        return checked(dds_create_reader(participant, topic(name), reliable().get(), nullptr));
    }
};

// Waits until a writer has its reader.
void wait_for_reader(dds_entity_t writer) {
    for (int tries = 0; tries < 2'000; tries++) {
        dds_publication_matched_status_t status;
        if (dds_get_publication_matched_status(writer, &status) == 0 && status.current_count > 0) return;
        usleep(10'000);
    }
    throw std::runtime_error("no reader was found");
}

// Blocks until a reader has something.
class Waiter {
public:
    Waiter(dds_entity_t participant, dds_entity_t reader) : set(checked(dds_create_waitset(participant))) {
        dds_entity_t condition = checked(dds_create_readcondition(reader, DDS_ANY_STATE));
        checked(dds_waitset_attach(set, condition, 0));
    }
    bool wait(dds_duration_t timeout) const { return checked(dds_waitset_wait(set, nullptr, 0, timeout)) > 0; }

private:
    dds_entity_t set;
};

// Takes everything that a reader has, and does `work` with each text.
template <typename Work>
void take(dds_entity_t reader, Work work) {
    constexpr int MOST = 32;
    void *samples[MOST] = {};
    dds_sample_info_t infos[MOST];
    int count = checked(dds_take(reader, samples, infos, MOST, MOST));
    for (int index = 0; index < count; index++)
        if (infos[index].valid_data) work(*static_cast<Text *>(samples[index]));
    if (count > 0) dds_return_loan(reader, samples, count);
}

void answer(Topics topics, dds_entity_t requests) {
    Waiter waiter(topics.participant, requests);
    std::map<uint64_t, dds_entity_t> replies;
    for (;;) {
        waiter.wait(DDS_INFINITY);
        take(requests, [&](Text &text) {
            auto found = replies.find(text.caller);
            if (found == replies.end()) {
                dds_entity_t writer = topics.writer("reply_" + std::to_string(text.caller));
                wait_for_reader(writer);
                found = replies.emplace(text.caller, writer).first;
            }
            dds_write(found->second, &text);
        });
    }
}

void count(Topics topics, dds_entity_t messages, void (*executed)()) {
    Waiter waiter(topics.participant, messages);
    for (;;) {
        waiter.wait(DDS_INFINITY);
        take(messages, [&](Text &) { executed(); });
    }
}

struct Caller {
    uint64_t id;
    dds_entity_t requests, messages, replies;
    Waiter waiter;

    Caller(const Topics &topics, uint64_t id)
        : id(id), requests(topics.writer("request")), messages(topics.writer("take")),
          replies(topics.reader("reply_" + std::to_string(id))), waiter(topics.participant, replies) {
        wait_for_reader(requests);
        wait_for_reader(messages);
    }

    long echo(const char *text) {
        Text request{id, const_cast<char *>(text)};
        checked(dds_write(requests, &request));
        long length = -1;
        while (length < 0) {
            if (!waiter.wait(PATIENCE)) throw std::runtime_error("no reply");
            take(replies, [&](Text &reply) { length = static_cast<long>(strlen(reply.text)); });
        }
        return length;
    }
};

} // namespace

extern "C" const char *peer_serve(uint32_t run, void (*executed)(void)) {
    return peer_guard<const char *>(nullptr, [&] {
        Topics topics{participant(run), std::to_string(run)};
        std::thread(answer, topics, topics.reader("request")).detach();
        std::thread(count, topics, topics.reader("take"), executed).detach();
        return "by its domain";
    });
}

extern "C" void *peer_connect(uint32_t run, const char *) {
    return peer_guard<void *>(nullptr, [&]() -> void * {
        static std::mutex mutex;
        std::lock_guard<std::mutex> lock(mutex);
        static Topics topics{participant(run), std::to_string(run)};
        static uint64_t callers = 0;
        auto caller = std::make_unique<Caller>(topics, (static_cast<uint64_t>(getpid()) << 32) + callers++);
        caller->echo("");
        return caller.release();
    });
}

extern "C" long peer_echo(void *caller, const char *text, size_t) {
    return peer_guard<long>(-1, [&] { return static_cast<Caller *>(caller)->echo(text); });
}

extern "C" int peer_send(void *pointer, const char *text, size_t) {
    return peer_guard<int>(1, [&] {
        Caller *caller = static_cast<Caller *>(pointer);
        Text message{caller->id, const_cast<char *>(text)};
        checked(dds_write(caller->messages, &message));
        return 0;
    });
}

extern "C" const char *peer_error() { return peer_last_error().c_str(); }
