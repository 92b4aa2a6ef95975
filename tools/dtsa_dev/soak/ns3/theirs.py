"""ns-3's side of the soak: runs in a Python that has the package ``ns3``, not in this project's.

Reads a question as JSON from standard input and writes the answer as JSON to standard output. It imports nothing of
this project: the other Python has only ns-3.

- ``carry``: frames that begin at given instants, on ``AlohaNoackNetDevice`` with ``HalfDuplexIdealPhy``. The answer
  says who received which, and when.
- ``contend``: senders with the unslotted CSMA/CA of ns-3's ``lr-wpan`` (IEEE 802.15.4), and one receiver that never
  sends. The answer says when each frame was handed over, and when it arrived.
"""

import json
import math
import sys
from importlib.metadata import version

#: Bytes of a packet of ns-3's ALOHA device: its headers (LLC/SNAP 8, ALOHA 12), the number of the frame, and zeros. Its
#: rate is a whole number of bit/s: with so many bytes it gives the time on the air to the ns.
_SIZE, _HEADERS = 1024, 8 + 12

# Python callbacks from C++ cost more than the simulation itself, so what happens at an event is compiled. Both classes
# only schedule what they are told and note what ns-3 reports.
_COMPILED = r"""
#include <vector>

struct Carry {
    std::vector<long long> heard;  // frame, receiver, ns: three after one another
    unsigned padding = 0;  // bytes after the number of the frame
    std::vector<ns3::Ptr<ns3::NetDevice>> devices;

    void Begin(unsigned frame, unsigned sender) {
        ns3::Ptr<ns3::Packet> packet = ns3::Create<ns3::Packet>(reinterpret_cast<const uint8_t*>(&frame), sizeof frame);
        packet->AddPaddingAtEnd(padding);
        devices[sender]->Send(packet, devices[sender]->GetBroadcast(), 1);
    }
    bool Receive(ns3::Ptr<ns3::NetDevice> device, ns3::Ptr<const ns3::Packet> packet, uint16_t, const ns3::Address&) {
        unsigned frame = 0;
        packet->CopyData(reinterpret_cast<uint8_t*>(&frame), sizeof frame);
        heard.insert(heard.end(), {frame, device->GetNode()->GetId(), ns3::Simulator::Now().GetNanoSeconds()});
        return true;
    }
    void Add(ns3::Ptr<ns3::NetDevice> device) {
        devices.push_back(device);
        device->SetReceiveCallback(ns3::MakeCallback(&Carry::Receive, this));
    }
    void At(long long ns, unsigned frame, unsigned sender) {
        ns3::Simulator::Schedule(ns3::NanoSeconds(ns), &Carry::Begin, this, frame, sender);
    }
};

// A sender hands the next frame over when the time is up that it waits after the last one has been sent or given up.
struct Contend {
    struct Sender {
        ns3::Ptr<ns3::lrwpan::LrWpanNetDevice> device;
        std::vector<long long> waits;  // ns, the next one last
        long long handed = 0;          // ns
    };
    std::vector<Sender> senders;
    std::vector<long long> sent;   // sender, ns handed over, ns of the last bit: three after one another
    std::vector<long long> heard;  // ns of the last bit
    long long given_up = 0;
    unsigned payload = 0;
    double signal = 1.0;  // over noise

    void Noise(ns3::Ptr<ns3::lrwpan::LrWpanNetDevice> device) {
        auto power = ns3::lrwpan::LrWpanSpectrumValueHelper().CreateTxPowerSpectralDensity(0.0, 11);
        device->GetPhy()->SetTxPowerSpectralDensity(power);
        device->GetPhy()->SetNoisePowerSpectralDensity(ns3::Create<ns3::SpectrumValue>(*power * (1.0 / signal)));
    }
    void Hand(unsigned k) {
        Sender& me = senders[k];
        me.handed = ns3::Simulator::Now().GetNanoSeconds();
        ns3::lrwpan::McpsDataRequestParams what;
        what.m_dstAddr = ns3::Mac16Address("ff:ff");
        what.m_dstPanId = 5;
        me.device->GetMac()->McpsDataRequest(what, ns3::Create<ns3::Packet>(payload));
    }
    void Wait(unsigned k) {
        Sender& me = senders[k];
        if (me.waits.empty()) return;
        ns3::Simulator::Schedule(ns3::NanoSeconds(me.waits.back()), &Contend::Hand, this, k);
        me.waits.pop_back();
    }
    void Over(unsigned k, ns3::lrwpan::McpsDataConfirmParams what) {
        if (what.m_status == ns3::lrwpan::MacStatus::SUCCESS)
            sent.insert(sent.end(), {(long long)k, senders[k].handed, ns3::Simulator::Now().GetNanoSeconds()});
        else
            ++given_up;
        Wait(k);
    }
    void Heard(ns3::lrwpan::McpsDataIndicationParams, ns3::Ptr<ns3::Packet>) {
        heard.push_back(ns3::Simulator::Now().GetNanoSeconds());
    }
    void Receiver(ns3::Ptr<ns3::NetDevice> device) {
        auto one = ns3::DynamicCast<ns3::lrwpan::LrWpanNetDevice>(device);
        Noise(one);
        one->GetMac()->SetMcpsDataIndicationCallback(ns3::MakeCallback(&Contend::Heard, this));
    }
    void Add(
        ns3::Ptr<ns3::NetDevice> device, const std::vector<long long>& waits, int min_be, int max_be, int backoffs) {
        auto one = ns3::DynamicCast<ns3::lrwpan::LrWpanNetDevice>(device);
        Noise(one);
        one->GetCsmaCa()->SetMacMaxBE(max_be);
        one->GetCsmaCa()->SetMacMinBE(min_be);
        one->GetCsmaCa()->SetMacMaxCSMABackoffs(backoffs);
        unsigned k = senders.size();
        senders.push_back({one, waits});
        one->GetMac()->SetMcpsDataConfirmCallback(ns3::MakeCallback(&Contend::Over, this).Bind(k));
        Wait(k);
    }
};

void fill(ns3::Ptr<ns3::SpectrumValue> value, double all) {
    for (auto band = value->ValuesBegin(); band != value->ValuesEnd(); ++band) *band = all;
}
"""


def _carry(ns, own, question):
    """Lets frames begin at given instants.

    :param question: ``positions`` [x, y, z] m of each agent, ``range_m`` (0: everywhere), ``on_air_ns`` of a frame,
        ``frames`` [index of the sender, ns] in the order of time.
    """
    import cppyy

    nodes = _standing(ns, question["positions"])
    channel = ns.CreateObject["SingleModelSpectrumChannel"]()
    if question["range_m"]:
        loss = ns.CreateObject["RangePropagationLossModel"]()
        loss.SetAttribute("MaxRange", ns.DoubleValue(question["range_m"]))
        channel.AddPropagationLossModel(loss)
        # Beyond the range 1000 dB are lost. Without this limit a receiver would lock on such a frame, and miss others.
        channel.SetAttribute("MaxLossDb", ns.DoubleValue(500.0))
    # A thousand times as much signal as noise; the rate is so near to what Shannon's limit allows then, by a
    # hundred-thousandth of a byte, that a frame bears no disturbance.
    on_air_ns, signal = question["on_air_ns"], 1000.0
    width = (_SIZE + 1.00001) * 8e9 / on_air_ns / math.log2(1.0 + signal)
    band = ns.BandInfo()
    band.fl, band.fc, band.fh = 1e9, 1e9 + width / 2, 1e9 + width
    bands = cppyy.gbl.std.vector["ns3::BandInfo"]()
    bands.push_back(band)
    model = ns.Create["SpectrumModel"](bands)
    noise, power = ns.Create["SpectrumValue"](model), ns.Create["SpectrumValue"](model)
    own.fill(noise, 1.0)
    own.fill(power, signal)
    helper = ns.AdhocAlohaNoackIdealPhyHelper()
    helper.SetChannel(channel)
    helper.SetTxPowerSpectralDensity(power)
    helper.SetNoisePowerSpectralDensity(noise)
    helper.SetPhyAttribute("Rate", ns.DataRateValue(ns.DataRate(_SIZE * 8_000_000_000 // on_air_ns)))
    devices = helper.Install(nodes)
    carry = own.Carry()
    carry.padding = _SIZE - _HEADERS - 4
    for index in range(devices.GetN()):
        carry.Add(devices.Get(index))
    for number, (sender, at_ns) in enumerate(question["frames"]):
        carry.At(at_ns, number, sender)
    ns.Simulator.Run()
    return {"heard": _by_three(carry.heard)}


def _contend(ns, own, question):
    """Lets senders contend, each for itself.

    :param question: ``payload`` bytes of a frame, ``waits_ns`` of each sender before its frames, ``min_be``, ``max_be``
        and ``backoffs`` of the CSMA/CA, ``end_ns`` of the run, ``seed``.
    """
    ns.RngSeedManager.SetSeed(question["seed"])
    nodes = _standing(ns, [[0.0, 0.0, 0.0]] * (len(question["waits_ns"]) + 1))
    channel = ns.CreateObject["SingleModelSpectrumChannel"]()
    # The helper wants both; all stand in one place, so nothing is delayed or weakened.
    channel.SetPropagationDelayModel(ns.CreateObject["ConstantSpeedPropagationDelayModel"]())
    channel.AddPropagationLossModel(ns.CreateObject["RangePropagationLossModel"]())
    helper = ns.LrWpanHelper()
    helper.SetChannel(channel)
    devices = helper.Install(nodes)
    helper.CreateAssociatedPan(devices, 5)
    contend = own.Contend()
    contend.payload = question["payload"]
    contend.signal = question["signal"]
    contend.Receiver(devices.Get(0))
    for index, waits in enumerate(question["waits_ns"], 1):
        contend.Add(devices.Get(index), waits[::-1], question["min_be"], question["max_be"], question["backoffs"])
    ns.Simulator.Stop(ns.NanoSeconds(question["end_ns"]))
    ns.Simulator.Run()
    return {"sent": _by_three(contend.sent), "heard": list(contend.heard), "given_up": contend.given_up}


def _standing(ns, positions):
    """Nodes that stand still.

    :param positions: [x, y, z] m of each.
    """
    nodes = ns.NodeContainer()
    nodes.Create(len(positions))
    places = ns.CreateObject["ListPositionAllocator"]()
    for place in positions:
        places.Add(ns.Vector(*place))
    mobility = ns.MobilityHelper()
    mobility.SetMobilityModel("ns3::ConstantPositionMobilityModel")
    mobility.SetPositionAllocator(places)
    mobility.Install(nodes)
    return nodes


def _by_three(numbers):
    flat = list(numbers)
    return [flat[k : k + 3] for k in range(0, len(flat), 3)]


def main():
    """Answers one question."""
    try:
        from ns import ns
    except ImportError:
        return 2
    import cppyy

    question = json.load(sys.stdin)
    cppyy.cppdef(_COMPILED)
    answer = {"carry": _carry, "contend": _contend}[question["kind"]](ns, cppyy.gbl, question)
    json.dump({**answer, "version": version("ns3")}, sys.stdout)
    return 0


if __name__ == "__main__":
    sys.exit(main())
