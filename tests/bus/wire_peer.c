/* The bus from C with libzmq (docs/wire.md).
   wire_peer sub SOCKET TOPIC COUNT: print kind, sequence, size and the sum of all bytes of COUNT messages.
   wire_peer pub SOCKET TOPIC IDENTITY TYPE_HASH: publish 8 bytes of CDR to the first subscriber, until stdin ends. */
#include <fcntl.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

/* From zmq.h, which the wheel of pyzmq does not have. */
void *zmq_ctx_new(void);
void *zmq_socket(void *context, int type);
int zmq_bind(void *socket, const char *endpoint);
int zmq_connect(void *socket, const char *endpoint);
int zmq_setsockopt(void *socket, int option, const void *value, size_t length);
int zmq_recv(void *socket, void *buffer, size_t length, int flags);
int zmq_send(void *socket, const void *buffer, size_t length, int flags);
enum { SUB = 2, XPUB = 9, SUBSCRIBE = 6, RCVTIMEO = 27, SNDMORE = 2 };

#pragma pack(push, 1)
struct header { uint8_t kind; char magic[4]; uint8_t version, zero[3]; uint64_t sequence; int64_t publish_ns;
                uint8_t publisher[8], type_hash[8]; uint64_t size; };
struct reference { uint32_t pid, descriptor, slot, oldest; };
#pragma pack(pop)

static void fail(const char *what) { perror(what); exit(1); }

static uint64_t sum(const uint8_t *data, uint64_t size) {
    uint64_t total = 0;
    while (size--) total += *data++;
    return total;
}

/* Sum of the bytes of a message in a slot; fails if it has been overwritten. */
static uint64_t sum_shared(const struct reference *at, const struct header *header) {
    char path[64];
    struct stat status;
    snprintf(path, sizeof path, "/proc/%u/fd/%u", at->pid, at->descriptor);
    int slot = open(path, O_RDONLY | O_CLOEXEC);
    if (slot < 0 || fstat(slot, &status) || (uint64_t)status.st_size < 60 + header->size) fail(path);
    if (flock(slot, LOCK_SH | LOCK_NB)) fail("flock");
    const uint8_t *memory = mmap(NULL, status.st_size, PROT_READ, MAP_SHARED, slot, 0);
    if (memory == MAP_FAILED || *(const uint64_t *)memory != header->sequence) fail("slot");
    uint64_t total = sum(memory + 60, header->size);
    munmap((void *)memory, status.st_size);
    close(slot); /* and unlock */
    return total;
}

static void unhex(const char *text, uint8_t out[8]) {
    for (int i = 0; i < 8; i++) { unsigned byte; sscanf(text + 2 * i, "%2x", &byte); out[i] = byte; }
}

int main(int count, char **arguments) {
    static uint8_t key[256], body[200000];
    struct header header;
    const char *topic = arguments[3];
    if (count < 5) return 2;
    int subscribes = !strcmp(arguments[1], "sub"), patience_ms = 30000;
    void *socket = zmq_socket(zmq_ctx_new(), subscribes ? SUB : XPUB);
    char endpoint[256];
    snprintf(endpoint, sizeof endpoint, "ipc://%s", arguments[2]);
    zmq_setsockopt(socket, RCVTIMEO, &patience_ms, sizeof patience_ms);
    if (subscribes) {
        zmq_setsockopt(socket, SUBSCRIBE, topic, strlen(topic));
        if (zmq_connect(socket, endpoint)) fail(endpoint);
        for (int left = atoi(arguments[4]); left; left--) {
            if (zmq_recv(socket, key, sizeof key, 0) != strlen(topic) + sizeof header) fail("receive");
            memcpy(&header, key + strlen(topic), sizeof header);
            if (zmq_recv(socket, body, sizeof body, 0) < 0) fail("body");
            if (memcmp(header.magic, "IIC", 4) || header.version != 4) fail("version");
            uint64_t total = header.kind ? sum_shared((struct reference *)body, &header) : sum(body, header.size);
            printf("%d %lu %lu %lu\n", header.kind, header.sequence, header.size, total);
            fflush(stdout);
        }
        return 0;
    }
    if (zmq_bind(socket, endpoint)) fail(endpoint);
    do {
        int size = zmq_recv(socket, key, sizeof key - 1, 0);
        if (size < 0) fail("subscription");
        key[size] = 0;
    } while (key[0] != 1 || strcmp((char *)key + 1, topic));
    memset(&header, 0, sizeof header);
    memcpy(header.magic, "IIC", 4);
    header.version = 4, header.sequence = 1, header.publish_ns = 5, header.size = 8;
    unhex(arguments[4], header.publisher), unhex(arguments[5], header.type_hash);
    memcpy(key, topic, strlen(topic)), memcpy(key + strlen(topic), &header, sizeof header);
    zmq_send(socket, key, strlen(topic) + sizeof header, SNDMORE);
    zmq_send(socket, "\0\1\0\0from", 8, 0);
    while (getchar() != EOF) {}
    return 0;
}
