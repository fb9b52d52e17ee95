// omniORB: CORBA over TCP, a connection and a server thread for each caller.

#include <cstdlib>
#include <mutex>
#include <stdexcept>

#include "../native/peer.h"
#include "echo.hh"

namespace {

void (*note)() = nullptr;

class Service : public POA_Mirror {
public:
    char *echo(const char *text) override { return CORBA::string_dup(text); }
    void take(const char *) override { note(); }
};

// Both ends keep texts as UTF-8, and up to 128 callers have a connection each. The server listens on its end of the cable
// where there is one, else on loopback; the caller's end has no other address than those two to listen on.
CORBA::ORB_var make_orb(bool serves) {
    const char *cable = serves ? std::getenv("CARA_BENCH_CABLE") : nullptr;
    const std::string end_point = std::string("giop:tcp:") + (cable ? cable : "127.0.0.1") + ":";
    const char *options[][2] = {
        {"nativeCharCodeSet", "UTF-8"},
        {"defaultCharCodeSet", "UTF-8"},
        {"endPoint", end_point.c_str()},
        {"maxGIOPConnectionPerServer", "128"},
        {"threadPerConnectionPolicy", "1"},
        {nullptr, nullptr},
    };
    int count = 0;
    return CORBA::ORB_init(count, nullptr, "omniORB4", options);
}

template <typename Result, typename Work>
Result guard(Result failed, Work work) {
    return peer_guard(failed, [&] {
        try {
            return work();
        } catch (const CORBA::Exception &error) {
            throw std::runtime_error(std::string("CORBA: ") + error._name());
        }
    });
}

} // namespace

extern "C" const char *peer_serve(uint32_t, void (*executed)()) {
    return guard<const char *>(nullptr, [&] {
        note = executed;
        static CORBA::ORB_var orb = make_orb(true);
        CORBA::Object_var object = orb->resolve_initial_references("RootPOA");
        PortableServer::POA_var poa = PortableServer::POA::_narrow(object);
        Service *service = new Service;
        PortableServer::ObjectId_var id = poa->activate_object(service);
        Mirror_var reference = service->_this();
        PortableServer::POAManager_var manager = poa->the_POAManager();
        manager->activate();
        return static_cast<const char *>(orb->object_to_string(reference));
    });
}

extern "C" void *peer_connect(uint32_t, const char *address) {
    return guard<void *>(nullptr, [&]() -> void * {
        static std::mutex mutex;
        std::lock_guard<std::mutex> lock(mutex);
        static CORBA::ORB_var orb = make_orb(false);
        CORBA::Object_var object = orb->string_to_object(address);
        Mirror_ptr echo = Mirror::_narrow(object);
        if (CORBA::is_nil(echo)) throw std::runtime_error("the address is not one of a Mirror");
        return echo;
    });
}

extern "C" long peer_echo(void *caller, const char *text, size_t) {
    return guard<long>(-1, [&] {
        CORBA::String_var answer = static_cast<Mirror_ptr>(caller)->echo(text);
        return static_cast<long>(strlen(answer));
    });
}

extern "C" int peer_send(void *caller, const char *text, size_t) {
    return guard<int>(1, [&] {
        static_cast<Mirror_ptr>(caller)->take(text);
        return 0;
    });
}

extern "C" const char *peer_error() { return peer_last_error().c_str(); }
