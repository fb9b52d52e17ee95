import java.io.BufferedReader;
import java.io.ByteArrayInputStream;
import java.io.ByteArrayOutputStream;
import java.io.IOException;
import java.io.InputStreamReader;
import java.io.ObjectInputStream;
import java.io.ObjectOutputStream;
import java.io.Serializable;
import java.lang.management.ManagementFactory;
import java.net.InetAddress;
import java.net.ServerSocket;
import java.net.Socket;
import java.rmi.Remote;
import java.rmi.RemoteException;
import java.rmi.server.RMIClientSocketFactory;
import java.rmi.server.RMIServerSocketFactory;
import java.rmi.server.UnicastRemoteObject;
import java.util.ArrayList;
import java.util.Base64;
import java.util.List;
import java.util.Random;
import java.util.concurrent.CyclicBarrier;
import java.util.concurrent.atomic.AtomicLong;
import java.util.regex.Matcher;
import java.util.regex.Pattern;

/**
 * Java RMI. It answers the questions of cara_bench_ends (see tests/experiments/bench/ends), one line of JSON each way, and measures as
 * that does: RMI has no messages without an answer, so it knows no bursts.
 */
public final class Peer {
    /** Calls of each caller before those that count. */
    private static final int WARM_UP = 3;
    /** Calls of each length before the process is asked anything. */
    private static final int COMPILED_AFTER = 3_000;
    private static final int FURTHER_NODES = 5;
    private static final int FURTHER_CHARS = 1_000;

    /** The service. */
    public interface Echo extends Remote {
        String echo(String text) throws RemoteException;
    }

    private static final class Service implements Echo {
        @Override
        public String echo(String text) {
            return text;
        }
    }

    /** Sockets on loopback. RMI turns Nagle off by itself. */
    private static final class Loopback implements RMIClientSocketFactory, RMIServerSocketFactory, Serializable {
        private static final long serialVersionUID = 1;

        @Override
        public Socket createSocket(String host, int port) throws IOException {
            return new Socket(InetAddress.getLoopbackAddress(), port);
        }

        @Override
        public ServerSocket createServerSocket(int port) throws IOException {
            return new ServerSocket(port, 128, InetAddress.getLoopbackAddress());
        }
    }

    private interface Answer {
        String to(String question) throws Exception;
    }

    /** What was timed of one caller, in nanoseconds. */
    private static final class Timed {
        long start;
        long end;
        long[] roundTrips;
        Exception failure;
    }

    public static void main(String[] arguments) throws Exception {
        System.setProperty("java.rmi.server.hostname", "127.0.0.1");
        String address = "";
        for (int i = 1; i + 1 < arguments.length; i++) {
            if (arguments[i].equals("--address")) {
                address = arguments[i + 1];
            }
        }
        switch (arguments[0]) {
            case "serve" -> serve();
            case "call" -> call(stub(address));
            case "further" -> further(stub(address));
            default -> throw new IllegalArgumentException("serve, call or further?");
        }
        System.exit(0);
    }

    private static void serve() throws Exception {
        Service service = new Service();
        Loopback loopback = new Loopback();
        Remote stub = UnicastRemoteObject.exportObject(service, 0, loopback, loopback);
        ByteArrayOutputStream bytes = new ByteArrayOutputStream();
        try (ObjectOutputStream out = new ObjectOutputStream(bytes)) {
            out.writeObject(stub);
        }
        say('"' + Base64.getEncoder().encodeToString(bytes.toByteArray()) + '"');
        answerAll(question -> switch (question) {
            case "\"CpuTime\"" -> Long.toString(cpuTime());
            case "\"Executed\"" -> "[0,0]";
            case "\"Counters\"" -> "{}";
            default -> throw new IllegalArgumentException("RMI cannot do this: " + question);
        });
    }

    private static Echo stub(String address) throws IOException, ClassNotFoundException {
        byte[] bytes = Base64.getDecoder().decode(address);
        try (ObjectInputStream in = new ObjectInputStream(new ByteArrayInputStream(bytes))) {
            return (Echo) in.readObject();
        }
    }

    private static void call(Echo echo) throws Exception {
        compile(echo);
        answerAll(question -> {
            if (question.startsWith("{\"Echo\"")) {
                return block(echo, question);
            }
            throw new IllegalArgumentException("RMI cannot do this: " + question);
        });
    }

    /** Lets the compiler see what is hot before anything is timed: a vehicle's programs run for days. */
    private static void compile(Echo echo) throws Exception {
        for (int chars : new int[] {100, 1_000, 20_000}) {
            String text = text(chars);
            for (int i = 0; i < COMPILED_AFTER; i++) {
                check(echo.echo(text), text);
            }
        }
    }

    /** One block: callers that start together, each call timed. RMI keeps a connection for each. */
    private static String block(Echo echo, String order) throws Exception {
        int callers = number(order, "callers");
        int calls = number(order, "calls_per_caller");
        String text = text(number(order, "chars"));
        long used = cpuTime();
        CyclicBarrier barrier = new CyclicBarrier(callers);
        List<Timed> all = new ArrayList<>();
        List<Thread> threads = new ArrayList<>();
        for (int i = 0; i < callers; i++) {
            Timed timed = new Timed();
            all.add(timed);
            Thread thread = new Thread(() -> makeCalls(echo, text, calls, order, barrier, timed));
            threads.add(thread);
            thread.start();
        }
        for (Thread thread : threads) {
            thread.join();
        }
        return outcome(all, cpuTime() - used, (long) callers * (WARM_UP + calls));
    }

    private static void makeCalls(
            Echo echo, String text, int calls, String order, CyclicBarrier barrier, Timed timed) {
        try {
            // Everyone passes the barrier, even after a failure: the others wait there.
            try {
                for (int i = 0; i < WARM_UP; i++) {
                    check(echo.echo(text), text);
                }
            } finally {
                barrier.await();
            }
            timed.roundTrips = new long[calls];
            long pause = number(order, "pause_ms");
            Thread.sleep(number(order, "delay_us") / 1_000);
            timed.start = System.nanoTime();
            timed.end = timed.start;
            for (int i = 0; i < calls; i++) {
                if (pause > 0) {
                    Thread.sleep(pause);
                    timed.end = System.nanoTime();
                }
                long before = timed.end;
                check(echo.echo(text), text);
                timed.end = System.nanoTime();
                timed.roundTrips[i] = timed.end - before;
            }
        } catch (Exception failure) {
            timed.failure = failure;
        }
    }

    private static void check(String answer, String text) {
        if (answer.length() != text.length()) {
            throw new IllegalStateException(answer.length() + " characters came back of " + text.length());
        }
    }

    private static String outcome(List<Timed> all, long cpu, long calls) throws Exception {
        long start = Long.MAX_VALUE;
        long end = Long.MIN_VALUE;
        StringBuilder roundTrips = new StringBuilder();
        for (Timed timed : all) {
            if (timed.failure != null) {
                throw timed.failure;
            }
            start = Math.min(start, timed.start);
            end = Math.max(end, timed.end);
            for (long nanos : timed.roundTrips) {
                roundTrips.append(roundTrips.length() == 0 ? "" : ",").append(nanos);
            }
        }
        return "{\"round_trips\":[" + roundTrips + "],\"elapsed\":" + (end - start) + ",\"cpu\":" + cpu
                + ",\"cpu_calls\":" + calls + "}";
    }

    /** The further nodes of distribution 2: each calls at random, while it is told to. */
    private static void further(Echo echo) throws Exception {
        AtomicLong done = new AtomicLong();
        boolean[] isCalling = {false};
        Exception[] failure = {null};
        String text = text(FURTHER_CHARS);
        for (int i = 0; i < FURTHER_NODES; i++) {
            Thread thread = new Thread(() -> {
                Random random = new Random();
                try {
                    while (true) {
                        synchronized (isCalling) {
                            while (!isCalling[0]) {
                                isCalling.wait();
                            }
                        }
                        Thread.sleep(1 + random.nextInt(20));
                        synchronized (isCalling) {
                            if (!isCalling[0]) {
                                continue;
                            }
                        }
                        check(echo.echo(text), text);
                        done.incrementAndGet();
                    }
                } catch (Exception error) {
                    synchronized (isCalling) {
                        failure[0] = error;
                    }
                }
            });
            thread.setDaemon(true);
            thread.start();
        }
        answerAll(question -> {
            synchronized (isCalling) {
                isCalling[0] = question.equals("true");
                isCalling.notifyAll();
                if (failure[0] != null) {
                    throw failure[0];
                }
            }
            return question.equals("true") ? "null" : Long.toString(done.get());
        });
    }

    /** As many characters of one byte each. */
    private static String text(int chars) {
        char[] text = new char[chars];
        for (int i = 0; i < chars; i++) {
            text[i] = (char) ('a' + i % 26);
        }
        return new String(text);
    }

    /** A number by its name. */
    private static int number(String question, String name) {
        Matcher matcher = Pattern.compile('"' + name + "\":(\\d+)").matcher(question);
        if (!matcher.find()) {
            throw new IllegalArgumentException(name + " is not given: " + question);
        }
        return Integer.parseInt(matcher.group(1));
    }

    private static long cpuTime() {
        return ((com.sun.management.OperatingSystemMXBean) ManagementFactory.getOperatingSystemMXBean())
                .getProcessCpuTime();
    }

    private static void answerAll(Answer answer) throws IOException {
        BufferedReader questions = new BufferedReader(new InputStreamReader(System.in));
        for (String line = questions.readLine(); line != null; line = questions.readLine()) {
            try {
                say("{\"Ok\":" + answer.to(line) + "}");
            } catch (Exception error) {
                say("{\"Err\":\"" + error.toString().replaceAll("[\"\\\\\\p{Cntrl}]", " ") + "\"}");
            }
        }
    }

    private static void say(String line) {
        System.out.println(line);
        System.out.flush();
    }
}
