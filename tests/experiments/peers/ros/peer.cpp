// ROS 1: a persistent service connection for each caller, and a topic for what wants no answer. The server's process
// starts a master of its own on loopback, which ends with it.

#include <arpa/inet.h>
#include <signal.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <unistd.h>

#include <map>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <thread>

#include <ros/ros.h>
#include <std_msgs/String.h>

#include "../native/peer.h"
#include "cara_peers/Echo.h"

namespace {

void (*note)() = nullptr;

bool echo(cara_peers::Echo::Request &request, cara_peers::Echo::Response &response) {
    response.text.swap(request.text);
    return true;
}

void take(const std_msgs::String::ConstPtr &) { note(); }

// A port of loopback that nobody has.
int free_port() {
    int socket = ::socket(AF_INET, SOCK_STREAM, 0);
    sockaddr_in address{};
    address.sin_family = AF_INET;
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    socklen_t length = sizeof address;
    bind(socket, reinterpret_cast<sockaddr *>(&address), sizeof address);
    getsockname(socket, reinterpret_cast<sockaddr *>(&address), &length);
    close(socket);
    return ntohs(address.sin_port);
}

void start_master(int port) {
    pid_t parent = getpid();
    pid_t child = fork();
    if (child < 0) throw std::runtime_error("cannot start rosmaster");
    if (child > 0) return;
    prctl(PR_SET_PDEATHSIG, SIGKILL);
    if (getppid() != parent) _exit(1);
    // Standard output carries answers.
    dup2(STDERR_FILENO, STDOUT_FILENO);
    close(STDIN_FILENO);
    execlp("rosmaster", "rosmaster", "--core", "-p", std::to_string(port).c_str(), static_cast<char *>(nullptr));
    _exit(1);
}

// Once in each process.
void init(uint32_t run, const std::string &master, const char *role) {
    setenv("ROS_IP", "127.0.0.1", 1);
    std::map<std::string, std::string> remappings{{"__master", master}, {"__ip", "127.0.0.1"}};
    std::string name = std::string(role) + std::to_string(run) + "_" + std::to_string(getpid());
    ros::init(remappings, name, ros::init_options::NoSigintHandler | ros::init_options::NoRosout);
    for (int tries = 0; !ros::master::check(); tries++) {
        if (tries > 300) throw std::runtime_error("rosmaster does not answer");
        usleep(100'000);
    }
}

struct Caller {
    ros::NodeHandle node;
    ros::ServiceClient echo;
    ros::Publisher take;
    cara_peers::Echo call;
};

} // namespace

extern "C" const char *peer_serve(uint32_t run, void (*executed)()) {
    return peer_guard<const char *>(nullptr, [&] {
        note = executed;
        static std::string master = "http://127.0.0.1:" + std::to_string(free_port()) + "/";
        start_master(std::stoi(master.substr(master.rfind(':') + 1)));
        init(run, master, "server");
        static ros::NodeHandle node;
        static ros::ServiceServer service = node.advertiseService("echo", echo);
        // No limit: a topic drops in silence what its queue does not hold.
        static ros::Subscriber topic = node.subscribe("take", 0, take, ros::TransportHints().tcpNoDelay());
        static ros::AsyncSpinner spinner(1);
        spinner.start();
        return master.c_str();
    });
}

extern "C" void *peer_connect(uint32_t run, const char *address) {
    return peer_guard<void *>(nullptr, [&]() -> void * {
        static std::mutex mutex;
        std::lock_guard<std::mutex> lock(mutex);
        if (!ros::isInitialized()) init(run, address, "client");
        auto caller = std::make_unique<Caller>();
        if (!ros::service::waitForService("echo", 20'000)) throw std::runtime_error("the service was not found");
        caller->echo = caller->node.serviceClient<cara_peers::Echo>("echo", true);
        caller->take = caller->node.advertise<std_msgs::String>("take", 0);
        static ros::AsyncSpinner spinner(1);
        spinner.start();
        for (int tries = 0; caller->take.getNumSubscribers() == 0; tries++) {
            if (tries > 200) throw std::runtime_error("nobody listens to the topic");
            usleep(100'000);
        }
        return caller.release();
    });
}

extern "C" long peer_echo(void *pointer, const char *text, size_t length) {
    return peer_guard<long>(-1, [&] {
        Caller *caller = static_cast<Caller *>(pointer);
        caller->call.request.text.assign(text, length);
        if (!caller->echo.call(caller->call)) throw std::runtime_error("the call failed");
        return static_cast<long>(caller->call.response.text.size());
    });
}

extern "C" int peer_send(void *caller, const char *text, size_t length) {
    return peer_guard<int>(1, [&] {
        std_msgs::String message;
        message.data.assign(text, length);
        static_cast<Caller *>(caller)->take.publish(message);
        return 0;
    });
}

extern "C" const char *peer_error() { return peer_last_error().c_str(); }
