// Publishes over Fast DDS what it reads: a line "TOPIC TYPE RELIABLE LATCHED BYTES", then the bytes,
// which are CDR. Without bytes the topic is announced only. Says "ready" on "?" once every topic has
// a reader.
#include <cstring>
#include <iostream>
#include <map>
#include <memory>
#include <sstream>
#include <string>
#include <thread>
#include <vector>

#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>

using namespace eprosima::fastdds::dds;
using eprosima::fastrtps::rtps::InstanceHandle_t;
using eprosima::fastrtps::rtps::SerializedPayload_t;
using Bytes = std::vector<char>;

class RawType : public TopicDataType {
public:
  explicit RawType(const std::string& name) {
    setName(name.c_str());
    m_typeSize = 8 << 20;
  }
  bool serialize(void* data, SerializedPayload_t* payload) override {
    const Bytes& bytes = *static_cast<Bytes*>(data);
    if (payload->max_size < bytes.size()) return false;
    std::memcpy(payload->data, bytes.data(), bytes.size());
    payload->length = bytes.size();
    payload->encapsulation = CDR_LE;
    return true;
  }
  bool deserialize(SerializedPayload_t*, void*) override { return false; }
  std::function<uint32_t()> getSerializedSizeProvider(void* data) override {
    return [data] { return static_cast<uint32_t>(static_cast<Bytes*>(data)->size()); };
  }
  void* createData() override { return new Bytes; }
  void deleteData(void* data) override { delete static_cast<Bytes*>(data); }
  bool getKey(void*, InstanceHandle_t*, bool) override { return false; }
};

int main(int count, char** arguments) {
  if (count != 2) return 2;
  auto* participant = DomainParticipantFactory::get_instance()->create_participant(
      std::stoi(arguments[1]), PARTICIPANT_QOS_DEFAULT);
  auto* publisher = participant->create_publisher(PUBLISHER_QOS_DEFAULT);
  std::map<std::string, DataWriter*> writers;
  std::string line;
  while (std::getline(std::cin, line)) {
    if (line == "?") {
      for (auto& [name, writer] : writers) {
        PublicationMatchedStatus status;
        do {
          writer->get_publication_matched_status(status);
          std::this_thread::sleep_for(std::chrono::milliseconds(10));
        } while (status.current_count == 0);
      }
      std::cout << "ready" << std::endl;
      continue;
    }
    std::istringstream words(line);
    std::string topic, type;
    bool reliable, latched;
    size_t size;
    words >> topic >> type >> reliable >> latched >> size;
    Bytes bytes(size);
    std::cin.read(bytes.data(), size);
    if (!writers.count(topic)) {
      TypeSupport support(new RawType(type));
      support.register_type(participant);
      DataWriterQos qos;
      qos.reliability().kind = reliable ? RELIABLE_RELIABILITY_QOS : BEST_EFFORT_RELIABILITY_QOS;
      qos.durability().kind = latched ? TRANSIENT_LOCAL_DURABILITY_QOS : VOLATILE_DURABILITY_QOS;
      qos.history().kind = KEEP_LAST_HISTORY_QOS;
      qos.history().depth = latched ? 1 : 100;
      qos.publish_mode().kind = ASYNCHRONOUS_PUBLISH_MODE;
      qos.endpoint().history_memory_policy =
          eprosima::fastrtps::rtps::DYNAMIC_RESERVE_MEMORY_MODE;
      auto* described = participant->create_topic(topic, type, TOPIC_QOS_DEFAULT);
      writers[topic] = publisher->create_datawriter(described, qos);
    }
    if (size) writers[topic]->write(&bytes);
  }
  std::this_thread::sleep_for(std::chrono::seconds(1));
  return 0;
}
